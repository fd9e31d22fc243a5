// Drives a robot through a world in Gazebo's physics.
//
//   drive_world WORLD.sdf MODEL LEFT_JOINT RIGHT_JOINT
//
// Simulates the world's static models and MODEL. Reads lines "LEFT RIGHT SECONDS": joint velocities in radians per
// second and their duration. Prints the pose of the model's first link as a line of JSON, at the start and after each
// command. Returns 0 at the end of the input, or prints the first problem to stderr and returns 1.

#include "world.hpp"

void drive(const fs::path &file, const std::string &name, const std::string &left, const std::string &right)
{
  const World world(file);
  const auto *model = world.Sdf().ModelByName(name);
  check(model != nullptr && !model->Static(), "the world has no dynamic model " + name);
  Engine engine(world, load_solids(world, [](const common::Mesh &, const std::string &) {}));
  const auto robot = engine.Add(*model);
  check(robot != nullptr, "the physics engine can't load model " + name);
  const auto joints = {robot->GetJoint(left), robot->GetJoint(right)};
  for (const auto &joint : joints) check(joint != nullptr, name + " has no joint " + left + " or " + right);
  const auto print_pose = [&] {
    std::cout << "{" << pose_members(robot->GetLink(0)->FrameDataRelativeToWorld()) << "}" << std::endl;
  };
  print_pose();
  double speeds[2], seconds;
  while (std::cin >> speeds[0] >> speeds[1] >> seconds)
  {
    for (int i = 0; i < std::lround(seconds * 1000); ++i)
    {
      const auto *speed = speeds;
      for (const auto &joint : joints) joint->SetVelocityCommand(0, *speed++);
      engine.Step();
    }
    print_pose();
  }
}

int main(int argc, char **argv)
{
  if (argc != 5)
  {
    std::cerr << "usage: drive_world WORLD.sdf MODEL LEFT_JOINT RIGHT_JOINT\n";
    return 2;
  }
  std::signal(SIGSEGV, report_crash);
  std::signal(SIGABRT, report_crash);
  try
  {
    common::Console::SetVerbosity(2);
    drive(argv[1], argv[2], argv[3], argv[4]);
    return 0;
  }
  catch (const std::exception &problem)
  {
    std::cerr << problem.what() << std::endl;
    return 1;
  }
}
