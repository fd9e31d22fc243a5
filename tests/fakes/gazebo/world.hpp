// Loads a world as Gazebo does: parsed with warnings as errors (libsdformat), meshes by ignition-common, collision
// shapes into DART (ignition-physics).

#pragma once

#include <cmath>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <iomanip>
#include <iostream>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <unistd.h>

#include <ignition/common/Console.hh>
#include <ignition/common/Material.hh>
#include <ignition/common/Mesh.hh>
#include <ignition/common/MeshManager.hh>
#include <ignition/common/SubMesh.hh>
#include <ignition/math/SphericalCoordinates.hh>
#include <ignition/physics/ConstructEmpty.hh>
#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/FrameSemantics.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Joint.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/mesh/MeshShape.hh>
#include <ignition/physics/sdf/ConstructModel.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <sdf/sdf.hh>

namespace fs = std::filesystem;
namespace math = ignition::math;
namespace common = ignition::common;
namespace physics = ignition::physics;

using Features = physics::FeatureList<
    physics::ConstructEmptyLinkFeature, physics::ConstructEmptyModelFeature, physics::ForwardStep,
    physics::GetEntities, physics::LinkFrameSemantics, physics::SetJointVelocityCommandFeature,
    physics::mesh::AttachMeshShapeFeature, physics::sdf::ConstructSdfModel, physics::sdf::ConstructSdfWorld>;

[[noreturn]] inline void fail(const std::string &problem) { throw std::runtime_error(problem); }

inline void check(bool good, const std::string &problem)
{
  if (!good) fail(problem);
}

inline std::string quoted(const std::string &text) { return '"' + text + '"'; }

inline std::string list(const std::vector<std::string> &items)
{
  std::string joined;
  for (const auto &item : items) joined += (joined.empty() ? "" : ", ") + item;
  return "[" + joined + "]";
}

inline std::string numbers(const math::Vector3d &v)
{
  std::ostringstream text;
  text << std::setprecision(9) << "[" << v.X() << ", " << v.Y() << ", " << v.Z() << "]";
  return text.str();
}

inline void check(const sdf::Errors &errors)
{
  for (const auto &error : errors) fail("SDF: " + error.Message() + " (" + error.FilePath().value_or("") + ")");
}

// Captures stderr during its lifetime: the libraries report e.g. a missing texture only there.
class CapturedStderr
{
 public:
  CapturedStderr() : stream(std::tmpfile()), original(dup(STDERR_FILENO))
  {
    std::fflush(stderr);
    dup2(fileno(this->stream), STDERR_FILENO);
  }
  ~CapturedStderr()
  {
    std::fflush(stderr);
    dup2(this->original, STDERR_FILENO);
    close(this->original);
    std::fclose(this->stream);
  }
  std::string Text() const
  {
    std::fflush(stderr);
    std::string text(lseek(fileno(this->stream), 0, SEEK_CUR), ' ');
    text.resize(pread(fileno(this->stream), text.data(), text.size(), 0));
    return text;
  }

 private:
  std::FILE *stream;
  int original;
};

// Gazebo's readers crash on some damaged files: the signal handler reports which.
inline std::string current_input = "the world";
inline const int true_stderr = dup(STDERR_FILENO);

inline void report_crash(int)
{
  dprintf(true_stderr, "Gazebo's readers crash on %s\n", current_input.c_str());
  _exit(1);
}

// Fails on captured errors and warnings, except that a collision mesh has no material.
inline void check_silent(const CapturedStderr &captured, const std::string &what)
{
  std::istringstream lines(captured.Text());
  for (std::string line; std::getline(lines, line);)
    if (line.find("Missing material for shape") == std::string::npos) fail(what + ": " + line);
}

// A parsed world; resolves model://NAME/PATH to paths below the world's folder, as a resource path would.
class World
{
 public:
  explicit World(const fs::path &file) : folder(fs::absolute(file).parent_path())
  {
    sdf::ParserConfig config;
    config.SetWarningsPolicy(sdf::EnforcementPolicy::ERR);
    config.SetUnrecognizedElementsPolicy(sdf::EnforcementPolicy::ERR);
    config.SetDeprecatedElementsPolicy(sdf::EnforcementPolicy::ERR);
    config.AddURIPath("model://", (this->folder / "models").string());
    check(this->root.Load(file.string(), config));
    check(this->root.WorldCount() == 1, "the file contains " + std::to_string(this->root.WorldCount()) + " worlds");
  }

  const sdf::World &Sdf() const { return *this->root.WorldByIndex(0); }

  std::string File(const std::string &uri) const
  {
    const std::string scheme = "model://";
    check(uri.rfind(scheme, 0) == 0, uri + " isn't a model:// URI");
    return "models/" + uri.substr(scheme.size());
  }

  fs::path Path(const std::string &file) const { return this->folder / file; }

 private:
  fs::path folder;
  sdf::Root root;
};

inline const common::Mesh &load(const World &world, const std::string &file)
{
  const auto path = world.Path(file);
  check(fs::is_regular_file(path), path.string() + " is missing");
  current_input = path.string();
  const CapturedStderr captured;
  const auto *mesh = common::MeshManager::Instance()->Load(path.string());
  check(mesh != nullptr, path.string() + " can't be loaded: " + captured.Text());
  check_silent(captured, path.string());
  return *mesh;
}

// A collision shape and its pose in the world: a mesh, or the SDF of a primitive shape.
struct Solid
{
  const common::Mesh *mesh;
  std::string shape;
  math::Pose3d pose;
  math::Vector3d scale;
};

// Collision shapes of all static models of a world; calls `on_mesh` with each loaded mesh and its file.
inline std::vector<Solid> load_solids(const World &world,
                                      const std::function<void(const common::Mesh &, const std::string &)> &on_mesh)
{
  std::vector<Solid> found;
  for (std::size_t m = 0; m < world.Sdf().ModelCount(); ++m)
  {
    const auto &model = *world.Sdf().ModelByIndex(m);
    if (!model.Static()) continue;  // the robot
    for (std::size_t l = 0; l < model.LinkCount(); ++l)
      for (std::size_t c = 0; c < model.LinkByIndex(l)->CollisionCount(); ++c)
      {
        const auto &collision = *model.LinkByIndex(l)->CollisionByIndex(c);
        const auto &geometry = *collision.Geom();
        math::Pose3d pose;
        check(collision.SemanticPose().Resolve(pose, "__model__"));
        const auto world_pose = model.RawPose() * pose;
        if (geometry.Type() != sdf::GeometryType::MESH)
        {
          found.push_back({nullptr, geometry.Element()->ToString(""), world_pose, math::Vector3d::One});
          continue;
        }
        const auto file = world.File(geometry.MeshShape()->Uri());
        const auto &mesh = load(world, file);
        on_mesh(mesh, file);
        found.push_back({&mesh, "", world_pose, geometry.MeshShape()->Scale()});
      }
  }
  check(!found.empty(), "the world has no static collision shapes");
  return found;
}

inline sdf::Root model(const std::string &name, const std::string &content)
{
  sdf::Root root;
  check(root.LoadSdfString("<sdf version='1.9'><model name='" + name + "'>" + content + "</model></sdf>"));
  return root;
}

// DART with the static collision shapes of a world.
class Engine
{
 public:
  using Model = physics::Model3dPtr<Features>;

  Engine(const World &world, const std::vector<Solid> &solids)
  {
    current_input = "all collision meshes";
    const auto names = this->loader.LoadLib(DARTSIM_PLUGIN);
    check(!names.empty(), std::string("no physics engine found in ") + DARTSIM_PLUGIN);
    this->engine = physics::RequestEngine3d<Features>::From(this->loader.Instantiate(*names.begin()));
    check(this->engine != nullptr, "the physics engine doesn't support a required feature");
    sdf::World empty;  // models are added below: the engine doesn't load meshes from SDF
    empty.SetName("world");
    empty.SetGravity(world.Sdf().Gravity());
    this->scene = this->engine->ConstructWorld(empty);
    for (std::size_t i = 0; i < solids.size(); ++i) this->Add(solids[i], "solid" + std::to_string(i));
  }

  // Adds a dynamic model.
  Model Add(const sdf::Model &model) { return this->scene->ConstructModel(model); }

  // Advances the simulation by one millisecond.
  void Step() { this->scene->Step(this->output, this->state, this->input); }

 private:
  void Add(const Solid &solid, const std::string &name)
  {
    std::ostringstream text;
    text << "<static>true</static><pose>" << solid.pose << "</pose><link name='link'>";
    if (solid.mesh == nullptr) text << "<collision name='shape'>" << solid.shape << "</collision>";
    text << "</link>";
    const auto link = this->Add(*model(name, text.str()).Model())->GetLink("link");
    if (solid.mesh == nullptr) return;
    const CapturedStderr captured;
    link->AttachMeshShape("mesh", *solid.mesh, Eigen::Isometry3d::Identity(),
                          Eigen::Vector3d(solid.scale.X(), solid.scale.Y(), solid.scale.Z()));
    check_silent(captured, "collision mesh");
  }

  ignition::plugin::Loader loader;
  physics::Engine3dPtr<Features> engine;
  physics::World3dPtr<Features> scene;
  physics::ForwardStep::Input input;
  physics::ForwardStep::State state;
  physics::ForwardStep::Output output;
};

// JSON members of a link's pose: position `rest`, orientation `lies` (quaternion w, x, y, z).
inline std::string pose_members(const physics::FrameData3d &frame)
{
  const Eigen::Vector3d position = frame.pose.translation();
  const Eigen::Quaterniond orientation(frame.pose.linear());
  std::ostringstream text;
  text << std::setprecision(9) << "\"rest\": " << numbers({position.x(), position.y(), position.z()})
       << ", \"lies\": [" << orientation.w() << ", " << orientation.x() << ", " << orientation.y() << ", "
       << orientation.z() << "]";
  return text.str();
}
