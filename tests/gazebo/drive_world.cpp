// Drives a robot through a world as Gazebo's physics does.
//
//   drive_world WORLD.sdf MODEL LEFT_JOINT RIGHT_JOINT
//
// The world's static models are there to collide with; of the others only MODEL is. Reads lines "LEFT RIGHT SECONDS": how
// fast its joints are to turn (radians a second) and for how long. Prints a line of JSON first, and one after each: where
// the model's first link is. Ends where the input does, and returns 0; or prints the first problem, and returns 1.

#include "world.hpp"

void drive(const fs::path &file, const std::string &name, const std::string &left, const std::string &right)
{
  const World world(file);
  const auto *model = world.Sdf().ModelByName(name);
  check(model != nullptr && !model->Static(), "the world has no model " + name + " that moves");
  Engine engine(world, solids(world, [](const common::Mesh &, const std::string &) {}));
  const auto robot = engine.Add(*model);
  check(robot != nullptr, "the physics engine takes no model " + name);
  const auto joints = {robot->GetJoint(left), robot->GetJoint(right)};
  for (const auto &joint : joints) check(joint != nullptr, name + " lacks a joint");
  const auto tell = [&] {
    std::cout << "{" << placed(robot->GetLink(0)->FrameDataRelativeToWorld()) << "}" << std::endl;
  };
  tell();
  double speeds[2], seconds;
  while (std::cin >> speeds[0] >> speeds[1] >> seconds)
  {
    for (int i = 0; i < std::lround(seconds * 1000); ++i)
    {
      const auto *speed = speeds;
      for (const auto &joint : joints) joint->SetVelocityCommand(0, *speed++);
      engine.Step();
    }
    tell();
  }
}

int main(int argc, char **argv)
{
  if (argc != 5)
  {
    std::cerr << "usage: drive_world WORLD.sdf MODEL LEFT_JOINT RIGHT_JOINT\n";
    return 2;
  }
  std::signal(SIGSEGV, crashed);
  std::signal(SIGABRT, crashed);
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
