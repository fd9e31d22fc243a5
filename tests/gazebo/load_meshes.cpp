// Loads meshes as Gazebo does, and says how long it took and how much memory.
//
//   load_meshes FILE ...
//
// Prints one line of JSON: the processor's seconds, and the megabytes by which the process grew at its largest.

#include <ctime>
#include <fstream>
#include <iostream>
#include <string>

#include <ignition/common/Console.hh>
#include <ignition/common/Mesh.hh>
#include <ignition/common/MeshManager.hh>

// The most memory that the process has had.
double megabytes()
{
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::stod(line.substr(6)) / 1e3;
  return 0;
}

int main(int argc, char **argv)
{
  ignition::common::Console::SetVerbosity(1);
  const double before = megabytes();
  const auto began = std::clock();
  for (int i = 1; i < argc; ++i)
    if (ignition::common::MeshManager::Instance()->Load(argv[i]) == nullptr)
    {
      std::cerr << argv[i] << " can't be loaded" << std::endl;
      return 1;
    }
  const double took = double(std::clock() - began) / CLOCKS_PER_SEC;
  std::cout << "{\"seconds\": " << took << ", \"megabytes\": " << megabytes() - before << "}" << std::endl;
  return 0;
}
