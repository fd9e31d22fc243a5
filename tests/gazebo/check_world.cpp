// Reads a world as Gazebo does and drops bodies in it.
//
//   check_world WORLD.sdf [BODY@X,Y,Z ...] [FILE=TRIANGLES ...]
//
// Parses the world with warnings as errors (libsdformat), loads the mesh of every visual and
// collision (ignition-common), checks their textures, normals and numbers of triangles, then lets
// bodies fall from (X, Y, Z), all at once, for two and a half seconds (ignition-physics, DART): a box of 40 cm, a
// ball of 22 cm, a car of 4.2 x 1.8 x 1.4 m. FILE is a mesh's path below the world's folder; files
// that the world doesn't show are loaded too.
//
// Prints one line of JSON and returns 0; or the first problem, and returns 1.

#include <csignal>
#include <cstdio>
#include <filesystem>
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
    physics::GetEntities, physics::LinkFrameSemantics, physics::mesh::AttachMeshShapeFeature,
    physics::sdf::ConstructSdfModel, physics::sdf::ConstructSdfWorld>;

constexpr int STEPS = 2500;  // of one millisecond

[[noreturn]] void fail(const std::string &problem) { throw std::runtime_error(problem); }

void check(bool good, const std::string &problem)
{
  if (!good) fail(problem);
}

std::string quoted(const std::string &text) { return '"' + text + '"'; }

std::string list(const std::vector<std::string> &items)
{
  std::string joined;
  for (const auto &item : items) joined += (joined.empty() ? "" : ", ") + item;
  return "[" + joined + "]";
}

std::string numbers(const math::Vector3d &v)
{
  std::ostringstream text;
  text << std::setprecision(9) << "[" << v.X() << ", " << v.Y() << ", " << v.Z() << "]";
  return text.str();
}

void check(const sdf::Errors &errors)
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
std::string at_work_on = "the world";
const int true_stderr = dup(STDERR_FILENO);

void crashed(int)
{
  dprintf(true_stderr, "%s makes Gazebo's readers crash\n", at_work_on.c_str());
  _exit(1);
}

// What it wrote is an error, or a warning that isn't about a collision mesh's lack of a material.
void check_silent(const Captured &said, const std::string &what)
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

const common::Mesh &load(const World &world, const std::string &file)
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

// JSON of a mesh, after its triangles, normals, texture coordinates and images are checked.
std::string checked(const common::Mesh &mesh, const std::string &file, const std::string &role,
                    std::optional<unsigned long> expected)
{
  unsigned long triangles = 0;
  std::vector<std::string> textures;
  for (unsigned i = 0; i < mesh.SubMeshCount(); ++i)
  {
    const auto part = mesh.SubMeshByIndex(i).lock();
    const std::string where = file + ", part " + std::to_string(i);
    check(part->SubMeshPrimitiveType() == common::SubMesh::TRIANGLES, where + " holds no triangles");
    triangles += part->IndexCount() / 3;
    if (role == "collision") continue;
    check(part->NormalCount() == part->VertexCount(), where + " lacks normals");
    check(part->TexCoordCount() == part->VertexCount(), where + " lacks texture coordinates");
    check(part->MaterialIndex() < mesh.MaterialCount(), where + " has no material");
    const auto image = mesh.MaterialByIndex(part->MaterialIndex())->TextureImage();
    check(!image.empty(), where + " has no texture");
    check(fs::is_regular_file(image), where + ": its texture " + image + " is missing");
    textures.push_back(quoted(fs::path(image).filename().string()));
  }
  check(triangles > 0, file + " has no triangles");
  if (expected)
    check(triangles == *expected, file + " has " + std::to_string(triangles) + " triangles where " +
                                      std::to_string(*expected) + " are expected");
  return "{\"file\": " + quoted(file) + ", \"role\": " + quoted(role) +
         ", \"triangles\": " + std::to_string(triangles) + ", \"textures\": " + list(textures) +
         ", \"low\": " + numbers(mesh.Min()) + ", \"high\": " + numbers(mesh.Max()) + "}";
}

// What is collided with, and its pose in the world: a mesh, or what SDF says of a simpler shape.
struct Solid
{
  const common::Mesh *mesh;
  std::string shape;
  math::Pose3d pose;
  math::Vector3d scale;
};

struct Body
{
  std::string kind;
  math::Vector3d start;
};

// SDF of a body's link: its mass (kg), moments of inertia and shape.
std::string link_of(const std::string &kind)
{
  const auto link = [](double mass, double x, double y, double z, const std::string &shape) {
    std::ostringstream text;
    text << "<link name='link'><inertial><mass>" << mass << "</mass><inertia><ixx>" << x << "</ixx><iyy>" << y
         << "</iyy><izz>" << z << "</izz></inertia></inertial><collision name='shape'><geometry>" << shape
         << "</geometry></collision></link>";
    return text.str();
  };
  if (kind == "box") return link(10, 0.27, 0.27, 0.27, "<box><size>0.4 0.4 0.4</size></box>");
  if (kind == "ball") return link(1, 0.00484, 0.00484, 0.00484, "<sphere><radius>0.11</radius></sphere>");
  if (kind == "car") return link(1200, 520, 1960, 2088, "<box><size>4.2 1.8 1.4</size></box>");
  fail("there is no body " + kind);
}

sdf::Root model(const std::string &name, const std::string &content)
{
  sdf::Root root;
  check(root.LoadSdfString("<sdf version='1.9'><model name='" + name + "'>" + content + "</model></sdf>"));
  return root;
}

// JSON of where the bodies came to rest, how they lie (a quaternion w, x, y, z) and their last speeds in m/s.
std::string drop(const World &world, const std::vector<Solid> &solids, const std::vector<Body> &bodies)
{
  at_work_on = "the collision meshes together";
  ignition::plugin::Loader loader;
  const auto names = loader.LoadLib(DARTSIM_PLUGIN);
  check(!names.empty(), std::string("no physics engine in ") + DARTSIM_PLUGIN);
  const auto engine = physics::RequestEngine3d<Features>::From(loader.Instantiate(*names.begin()));
  check(engine != nullptr, "the physics engine lacks a feature");

  sdf::World empty;  // the models are added below: the engine takes no mesh from SDF
  empty.SetName("world");
  empty.SetGravity(world.Sdf().Gravity());
  const auto scene = engine->ConstructWorld(empty);
  for (std::size_t i = 0; i < solids.size(); ++i)
  {
    const auto &solid = solids[i];
    std::ostringstream text;
    text << "<static>true</static><pose>" << solid.pose << "</pose><link name='link'>";
    if (solid.mesh == nullptr) text << "<collision name='shape'>" << solid.shape << "</collision>";
    text << "</link>";
    const auto link = scene->ConstructModel(*model("solid" + std::to_string(i), text.str()).Model())->GetLink("link");
    if (solid.mesh == nullptr) continue;
    const Captured said;
    link->AttachMeshShape("mesh", *solid.mesh, Eigen::Isometry3d::Identity(),
                          Eigen::Vector3d(solid.scale.X(), solid.scale.Y(), solid.scale.Z()));
    check_silent(said, "collision mesh");
  }
  std::vector<decltype(scene->ConstructModel(sdf::Model())->GetLink("link"))> links;
  for (std::size_t i = 0; i < bodies.size(); ++i)
  {
    std::ostringstream text;
    text << "<pose>" << bodies[i].start << " 0 0 0</pose>" << link_of(bodies[i].kind);
    links.push_back(scene->ConstructModel(*model("body" + std::to_string(i), text.str()).Model())->GetLink("link"));
  }

  physics::ForwardStep::Input input;
  physics::ForwardStep::State state;
  physics::ForwardStep::Output output;
  for (int i = 0; i < STEPS && !bodies.empty(); ++i) scene->Step(output, state, input);
  std::vector<std::string> rests;
  for (const auto &link : links)
  {
    const auto frame = link->FrameDataRelativeToWorld();
    const Eigen::Vector3d at = frame.pose.translation();
    const Eigen::Quaterniond lies(frame.pose.linear());
    std::ostringstream text;
    text << std::setprecision(9) << "{\"rest\": " << numbers({at.x(), at.y(), at.z()}) << ", \"lies\": [" << lies.w()
         << ", " << lies.x() << ", " << lies.y() << ", " << lies.z() << "], \"speed\": " << frame.linearVelocity.norm()
         << "}";
    rests.push_back(text.str());
  }
  return list(rests);
}

std::string spherical(const sdf::World &world)
{
  const auto *place = world.SphericalCoordinates();
  if (place == nullptr) return "null";
  std::ostringstream text;
  text << std::setprecision(12) << "{\"latitude\": " << place->LatitudeReference().Degree()
       << ", \"longitude\": " << place->LongitudeReference().Degree()
       << ", \"elevation\": " << place->ElevationReference()
       << ", \"heading\": " << place->HeadingOffset().Degree();
  // what a NavSat sensor would read a hundred metres along the world's y axis
  const auto there = place->PositionTransform(math::Vector3d(0, 100, 0), math::SphericalCoordinates::LOCAL2,
                                              math::SphericalCoordinates::SPHERICAL);
  text << ", \"at_y_100\": [" << IGN_RTOD(there.X()) << ", " << IGN_RTOD(there.Y()) << "]}";
  return text.str();
}

std::string run(const fs::path &file, const std::vector<Body> &bodies, std::map<std::string, unsigned long> expected)
{
  const World world(file);
  const auto &sdf = world.Sdf();
  check(sdf.ModelCount() > 0, "the world holds no model");
  std::vector<std::string> meshes;
  std::vector<Solid> solids;
  const auto take = [&](const sdf::Geometry &geometry, const std::string &role) -> const common::Mesh * {
    if (geometry.Type() != sdf::GeometryType::MESH) return nullptr;
    const auto name = world.File(geometry.MeshShape()->Uri());
    const auto &mesh = load(world, name);
    const auto count = expected.find(name);
    const bool known = count != expected.end();
    check(known || expected.empty(), name + " is shown, but no number of triangles is given for it");
    meshes.push_back(checked(mesh, name, role, known ? std::optional(count->second) : std::nullopt));
    if (known) expected.erase(count);
    return &mesh;
  };
  for (std::size_t m = 0; m < sdf.ModelCount(); ++m)
  {
    const auto &model = *sdf.ModelByIndex(m);
    if (!model.Static()) continue;  // the robot, which isn't what bodies are dropped on
    for (std::size_t l = 0; l < model.LinkCount(); ++l)
    {
      const auto &link = *model.LinkByIndex(l);
      for (std::size_t v = 0; v < link.VisualCount(); ++v) take(*link.VisualByIndex(v)->Geom(), "visual");
      for (std::size_t c = 0; c < link.CollisionCount(); ++c)
      {
        const auto &collision = *link.CollisionByIndex(c);
        const auto *mesh = take(*collision.Geom(), "collision");
        math::Pose3d pose;
        check(collision.SemanticPose().Resolve(pose, "__model__"));
        const auto place = model.RawPose() * pose;
        if (mesh == nullptr)
          solids.push_back({nullptr, collision.Geom()->Element()->ToString(""), place, math::Vector3d::One});
        else
          solids.push_back({mesh, "", place, collision.Geom()->MeshShape()->Scale()});
      }
    }
  }
  for (const auto &[name, count] : std::map(expected)) meshes.push_back(checked(load(world, name), name, "spare", count));
  check(!solids.empty(), "nothing to collide with");
  std::ostringstream json;
  json << "{\"world\": " << quoted(sdf.Name()) << ", \"spherical\": " << spherical(sdf)
       << ", \"meshes\": " << list(meshes) << ", \"solids\": " << solids.size()
       << ", \"bodies\": " << drop(world, solids, bodies) << "}";
  return json.str();
}

int main(int argc, char **argv)
{
  if (argc < 2)
  {
    std::cerr << "usage: check_world WORLD.sdf [BODY@X,Y,Z ...] [FILE=TRIANGLES ...]\n";
    return 2;
  }
  std::signal(SIGSEGV, crashed);
  std::signal(SIGABRT, crashed);
  try
  {
    common::Console::SetVerbosity(2);
    std::map<std::string, unsigned long> expected;
    std::vector<Body> bodies;
    for (int i = 2; i < argc; ++i)
    {
      const std::string text = argv[i];
      const auto at = text.rfind('='), where = text.find('@');
      double x, y, z;
      if (at != std::string::npos)
        expected[text.substr(0, at)] = std::stoul(text.substr(at + 1));
      else if (where != std::string::npos && std::sscanf(text.c_str() + where, "@%lf,%lf,%lf", &x, &y, &z) == 3)
        bodies.push_back({text.substr(0, where), {x, y, z}});
      else
        fail(text + " is neither BODY@X,Y,Z nor FILE=TRIANGLES");
    }
    std::cout << run(argv[1], bodies, expected) << std::endl;
    return 0;
  }
  catch (const std::exception &problem)
  {
    std::cerr << problem.what() << std::endl;
    return 1;
  }
}
