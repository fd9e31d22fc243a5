// Loads a world as Gazebo does and drops bodies in it.
//
//   check_world WORLD.sdf [BODY@X,Y,Z ...] [FILE=TRIANGLES ...]
//
// Parses the world with warnings as errors (libsdformat), loads the mesh of every visual and
// collision (ignition-common), checks their textures, normals and numbers of triangles, then drops
// bodies from (X, Y, Z), all at the same time, for two and a half seconds (ignition-physics, DART): a box of 40 cm, a
// ball of 22 cm, a car of 4.2 x 1.8 x 1.4 m. FILE is the path of a mesh below the world's folder; files
// that the world doesn't reference are loaded too.
//
// Prints one line of JSON and returns 0, or prints the first problem to stderr and returns 1.

#include "world.hpp"

constexpr int STEPS = 2500;  // of one millisecond each

// Checks triangles, normals, texture coordinates and textures of a mesh; returns its description as JSON.
std::string check_mesh(const common::Mesh &mesh, const std::string &file, const std::string &role,
                       std::optional<unsigned long> expected)
{
  unsigned long triangles = 0;
  std::vector<std::string> textures;
  for (unsigned i = 0; i < mesh.SubMeshCount(); ++i)
  {
    const auto part = mesh.SubMeshByIndex(i).lock();
    const std::string where = file + ", part " + std::to_string(i);
    check(part->SubMeshPrimitiveType() == common::SubMesh::TRIANGLES, where + " has no triangles");
    triangles += part->IndexCount() / 3;
    if (role == "collision") continue;
    check(part->NormalCount() == part->VertexCount(), where + " has vertices without normals");
    check(part->TexCoordCount() == part->VertexCount(), where + " has vertices without texture coordinates");
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
  fail("unknown body " + kind + ": expected box, ball or car");
}

// Drops bodies; returns JSON of their final positions, orientations and speeds in m/s.
std::string drop(const World &world, const std::vector<Solid> &solids, const std::vector<Body> &bodies)
{
  Engine engine(world, solids);
  std::vector<decltype(engine.Add(sdf::Model())->GetLink("link"))> links;
  for (std::size_t i = 0; i < bodies.size(); ++i)
  {
    std::ostringstream text;
    text << "<pose>" << bodies[i].start << " 0 0 0</pose>" << link_of(bodies[i].kind);
    links.push_back(engine.Add(*model("body" + std::to_string(i), text.str()).Model())->GetLink("link"));
  }
  for (int i = 0; i < STEPS && !bodies.empty(); ++i) engine.Step();
  std::vector<std::string> rests;
  for (const auto &link : links)
  {
    const auto frame = link->FrameDataRelativeToWorld();
    std::ostringstream text;
    text << std::setprecision(9) << "{" << pose_members(frame) << ", \"speed\": " << frame.linearVelocity.norm() << "}";
    rests.push_back(text.str());
  }
  return list(rests);
}

// JSON of the world's geographic reference, null if it has none.
std::string spherical(const sdf::World &world)
{
  const auto *coordinates = world.SphericalCoordinates();
  if (coordinates == nullptr) return "null";
  std::ostringstream text;
  text << std::setprecision(12) << "{\"latitude\": " << coordinates->LatitudeReference().Degree()
       << ", \"longitude\": " << coordinates->LongitudeReference().Degree()
       << ", \"elevation\": " << coordinates->ElevationReference()
       << ", \"heading\": " << coordinates->HeadingOffset().Degree();
  // reading of a NavSat sensor a hundred metres along the world's y axis
  const auto navsat = coordinates->PositionTransform(math::Vector3d(0, 100, 0), math::SphericalCoordinates::LOCAL2,
                                                     math::SphericalCoordinates::SPHERICAL);
  text << ", \"at_y_100\": [" << IGN_RTOD(navsat.X()) << ", " << IGN_RTOD(navsat.Y()) << "]}";
  return text.str();
}

std::string run(const fs::path &file, const std::vector<Body> &bodies, std::map<std::string, unsigned long> expected)
{
  const World world(file);
  const auto &sdf = world.Sdf();
  check(sdf.ModelCount() > 0, "the world has no model");
  std::vector<std::string> meshes;
  const auto add_mesh = [&](const common::Mesh &mesh, const std::string &name, const std::string &role) {
    const auto count = expected.find(name);
    const bool known = count != expected.end();
    check(known || expected.empty(), name + " is used by the world, but its expected number of triangles isn't given");
    meshes.push_back(check_mesh(mesh, name, role, known ? std::optional(count->second) : std::nullopt));
    if (known) expected.erase(count);
  };
  for (std::size_t m = 0; m < sdf.ModelCount(); ++m)
    for (std::size_t l = 0; l < sdf.ModelByIndex(m)->LinkCount(); ++l)
    {
      const auto &link = *sdf.ModelByIndex(m)->LinkByIndex(l);
      for (std::size_t v = 0; v < link.VisualCount(); ++v)
      {
        const auto &geometry = *link.VisualByIndex(v)->Geom();
        if (geometry.Type() != ::sdf::GeometryType::MESH) continue;
        const auto name = world.File(geometry.MeshShape()->Uri());
        add_mesh(load(world, name), name, "visual");
      }
    }
  const auto solids =
      load_solids(world, [&](const common::Mesh &mesh, const std::string &name) { add_mesh(mesh, name, "collision"); });
  for (const auto &[name, count] : std::map(expected))
    meshes.push_back(check_mesh(load(world, name), name, "spare", count));
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
  std::signal(SIGSEGV, report_crash);
  std::signal(SIGABRT, report_crash);
  try
  {
    common::Console::SetVerbosity(2);
    std::map<std::string, unsigned long> expected;
    std::vector<Body> bodies;
    for (int i = 2; i < argc; ++i)
    {
      const std::string text = argv[i];
      const auto equals = text.rfind('='), at = text.find('@');
      double x, y, z;
      if (equals != std::string::npos)
        expected[text.substr(0, equals)] = std::stoul(text.substr(equals + 1));
      else if (at != std::string::npos && std::sscanf(text.c_str() + at, "@%lf,%lf,%lf", &x, &y, &z) == 3)
        bodies.push_back({text.substr(0, at), {x, y, z}});
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
