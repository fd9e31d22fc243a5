// Casts rays through the visuals of a world.
//
//   cast_rays WORLD.sdf < RAYS
//
// Loads what Gazebo's sensor gpu_lidar renders: the meshes of all visuals of static models that its visibility_mask
// shows (ignition-common), at their poses and scales (libsdformat). Rendering itself (ignition-rendering) isn't in
// Debian, so rays are cast by Bullet, one of the engines of ignition-physics. Reads lines "X Y Z DX DY DZ": origin and
// unit vector of a ray, world coordinates. Prints a line for each: its range in metres (-1 without a hit), the visual's
// name and its laser_retro. Returns 0, or prints the first problem to stderr and returns 1.

#include "world.hpp"

#include <memory>

#include <BulletCollision/CollisionDispatch/btCollisionWorld.h>
#include <BulletCollision/CollisionDispatch/btDefaultCollisionConfiguration.h>
#include <BulletCollision/CollisionShapes/btBvhTriangleMeshShape.h>
#include <BulletCollision/CollisionShapes/btTriangleMesh.h>
#include <btBulletCollisionCommon.h>

constexpr double MAX_RANGE = 200;  // metres
constexpr std::uint32_t VISIBILITY_MASK = 0xFFFFFFFD;  // of the lidar: all but the backdrop (docs/backdrop.md)

struct Visual
{
  std::string name;
  double retro;
  std::unique_ptr<btTriangleMesh> triangles;
  std::unique_ptr<btBvhTriangleMeshShape> shape;
  btCollisionObject object;
};

std::unique_ptr<btTriangleMesh> triangles_of(const common::Mesh &mesh, const math::Pose3d &pose,
                                             const math::Vector3d &scale)
{
  auto found = std::make_unique<btTriangleMesh>();
  for (unsigned i = 0; i < mesh.SubMeshCount(); ++i)
  {
    const auto part = mesh.SubMeshByIndex(i).lock();
    const auto corner = [&](unsigned k) {
      const auto v = pose.CoordPositionAdd(part->Vertex(part->Index(k)) * scale);
      return btVector3(v.X(), v.Y(), v.Z());
    };
    for (unsigned k = 0; k + 2 < part->IndexCount(); k += 3) found->addTriangle(corner(k), corner(k + 1), corner(k + 2));
  }
  return found;
}

std::vector<std::unique_ptr<Visual>> load_visuals(const World &world)
{
  std::vector<std::unique_ptr<Visual>> found;
  for (std::size_t m = 0; m < world.Sdf().ModelCount(); ++m)
  {
    const auto &model = *world.Sdf().ModelByIndex(m);
    if (!model.Static()) continue;  // the robot
    for (std::size_t l = 0; l < model.LinkCount(); ++l)
      for (std::size_t v = 0; v < model.LinkByIndex(l)->VisualCount(); ++v)
      {
        const auto &source = *model.LinkByIndex(l)->VisualByIndex(v);
        if (!(source.VisibilityFlags() & VISIBILITY_MASK)) continue;
        const auto &geometry = *source.Geom();
        check(geometry.Type() == sdf::GeometryType::MESH, source.Name() + " isn't a mesh: not supported");
        math::Pose3d pose;
        check(source.SemanticPose().Resolve(pose, "__model__"));
        auto visual = std::make_unique<Visual>();
        visual->name = source.Name();
        visual->retro = source.HasLaserRetro() ? source.LaserRetro() : 0;
        visual->triangles = triangles_of(load(world, world.File(geometry.MeshShape()->Uri())), model.RawPose() * pose,
                                         geometry.MeshShape()->Scale());
        visual->shape = std::make_unique<btBvhTriangleMeshShape>(visual->triangles.get(), false);
        visual->object.setCollisionShape(visual->shape.get());
        visual->object.setUserPointer(visual.get());
        found.push_back(std::move(visual));
      }
  }
  return found;
}

void cast(const fs::path &file)
{
  const World world(file);
  const auto visuals = load_visuals(world);
  btDefaultCollisionConfiguration configuration;
  btCollisionDispatcher dispatcher(&configuration);
  btDbvtBroadphase broadphase;
  btCollisionWorld scene(&dispatcher, &broadphase, &configuration);
  for (const auto &visual : visuals) scene.addCollisionObject(&visual->object);
  std::cout << std::setprecision(9);
  double x, y, z, dx, dy, dz;
  while (std::cin >> x >> y >> z >> dx >> dy >> dz)
  {
    const btVector3 from(x, y, z), to = from + btVector3(dx, dy, dz) * MAX_RANGE;
    btCollisionWorld::ClosestRayResultCallback hit(from, to);
    scene.rayTest(from, to, hit);
    if (!hit.hasHit())
    {
      std::cout << "-1\n";
      continue;
    }
    const auto &visual = *static_cast<const Visual *>(hit.m_collisionObject->getUserPointer());
    std::cout << hit.m_closestHitFraction * MAX_RANGE << " " << visual.name << " " << visual.retro << "\n";
  }
  for (const auto &visual : visuals) scene.removeCollisionObject(&visual->object);
  std::cout << std::flush;
}

int main(int argc, char **argv)
{
  if (argc != 2)
  {
    std::cerr << "usage: cast_rays WORLD.sdf < RAYS\n";
    return 2;
  }
  std::signal(SIGSEGV, report_crash);
  std::signal(SIGABRT, report_crash);
  try
  {
    common::Console::SetVerbosity(2);
    cast(argv[1]);
    return 0;
  }
  catch (const std::exception &problem)
  {
    std::cerr << problem.what() << std::endl;
    return 1;
  }
}
