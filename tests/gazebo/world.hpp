// A world as Gazebo reads it: parsed with warnings as errors (libsdformat), its meshes loaded (ignition-common), what
// bodies collide with put into DART (ignition-physics).

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

// What the libraries write to stderr while it lives: they report a missing texture there, and go on.
class Captured
{
 public:
  Captured() : stream(std::tmpfile()), before(dup(STDERR_FILENO))
  {
    std::fflush(stderr);
    dup2(fileno(this->stream), STDERR_FILENO);
  }
  ~Captured()
  {
    std::fflush(stderr);
    dup2(this->before, STDERR_FILENO);
    close(this->before);
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
  int before;
};

// Gazebo's readers crash on some damaged files: say on which.
inline std::string at_work_on = "the world";
inline const int true_stderr = dup(STDERR_FILENO);

inline void crashed(int)
{
  dprintf(true_stderr, "%s makes Gazebo's readers crash\n", at_work_on.c_str());
  _exit(1);
}

// What it wrote is an error, or a warning that isn't about a collision mesh's lack of a material.
inline void check_silent(const Captured &said, const std::string &what)
{
  std::istringstream lines(said.Text());
  for (std::string line; std::getline(lines, line);)
    if (line.find("Missing material for shape") == std::string::npos) fail(what + ": " + line);
}

// Resolves model://NAME/PATH and paths below the world's folder, as a resource path would.
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
    check(this->root.WorldCount() == 1, "the file holds " + std::to_string(this->root.WorldCount()) + " worlds");
  }

  const sdf::World &Sdf() const { return *this->root.WorldByIndex(0); }

  std::string File(const std::string &uri) const
  {
    const std::string scheme = "model://";
    check(uri.rfind(scheme, 0) == 0, uri + " is no model:// address");
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
  at_work_on = path.string();
  const Captured said;
  const auto *mesh = common::MeshManager::Instance()->Load(path.string());
  check(mesh != nullptr, path.string() + " can't be loaded: " + said.Text());
  check_silent(said, path.string());
  return *mesh;
}

// What is collided with, and its pose in the world: a mesh, or what SDF says of a simpler shape.
struct Solid
{
  const common::Mesh *mesh;
  std::string shape;
  math::Pose3d pose;
  math::Vector3d scale;
};

// All shapes of a world that bodies collide with and that don't move; `seen` is told of their meshes and files.
inline std::vector<Solid> solids(const World &world,
                                 const std::function<void(const common::Mesh &, const std::string &)> &seen)
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
        const auto place = model.RawPose() * pose;
        if (geometry.Type() != sdf::GeometryType::MESH)
        {
          found.push_back({nullptr, geometry.Element()->ToString(""), place, math::Vector3d::One});
          continue;
        }
        const auto file = world.File(geometry.MeshShape()->Uri());
        const auto &mesh = load(world, file);
        seen(mesh, file);
        found.push_back({&mesh, "", place, geometry.MeshShape()->Scale()});
      }
  }
  check(!found.empty(), "nothing to collide with");
  return found;
}

inline sdf::Root model(const std::string &name, const std::string &content)
{
  sdf::Root root;
  check(root.LoadSdfString("<sdf version='1.9'><model name='" + name + "'>" + content + "</model></sdf>"));
  return root;
}

// DART with what doesn't move in a world.
class Engine
{
 public:
  using Model = physics::Model3dPtr<Features>;

  Engine(const World &world, const std::vector<Solid> &solids)
  {
    at_work_on = "the collision meshes together";
    const auto names = this->loader.LoadLib(DARTSIM_PLUGIN);
    check(!names.empty(), std::string("no physics engine in ") + DARTSIM_PLUGIN);
    this->engine = physics::RequestEngine3d<Features>::From(this->loader.Instantiate(*names.begin()));
    check(this->engine != nullptr, "the physics engine lacks a feature");
    sdf::World empty;  // the models are added below: the engine takes no mesh from SDF
    empty.SetName("world");
    empty.SetGravity(world.Sdf().Gravity());
    this->scene = this->engine->ConstructWorld(empty);
    for (std::size_t i = 0; i < solids.size(); ++i) this->Add(solids[i], "solid" + std::to_string(i));
  }

  // A model that moves.
  Model Add(const sdf::Model &model) { return this->scene->ConstructModel(model); }

  // A millisecond passes.
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
    const Captured said;
    link->AttachMeshShape("mesh", *solid.mesh, Eigen::Isometry3d::Identity(),
                          Eigen::Vector3d(solid.scale.X(), solid.scale.Y(), solid.scale.Z()));
    check_silent(said, "collision mesh");
  }

  ignition::plugin::Loader loader;
  physics::Engine3dPtr<Features> engine;
  physics::World3dPtr<Features> scene;
  physics::ForwardStep::Input input;
  physics::ForwardStep::State state;
  physics::ForwardStep::Output output;
};

// JSON of where a link is, and how it lies (a quaternion w, x, y, z).
inline std::string placed(const physics::FrameData3d &frame)
{
  const Eigen::Vector3d at = frame.pose.translation();
  const Eigen::Quaterniond lies(frame.pose.linear());
  std::ostringstream text;
  text << std::setprecision(9) << "\"rest\": " << numbers({at.x(), at.y(), at.z()}) << ", \"lies\": [" << lies.w()
       << ", " << lies.x() << ", " << lies.y() << ", " << lies.z() << "]";
  return text.str();
}
