// Loads meshes as Gazebo does, and measures CPU time and memory.
//
//   load_meshes FILE ...
//
// Prints one line of JSON: CPU time in seconds, and increase of the process's peak memory in megabytes.

#include <ctime>
#include <fstream>
#include <iostream>
#include <string>

#include <ignition/common/Console.hh>
#include <ignition/common/Mesh.hh>
#include <ignition/common/MeshManager.hh>

// Peak memory of the process.
double peak_megabytes()
{
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::stod(line.substr(6)) / 1e3;
  return 0;
}

int main(int argc, char **argv)
{
  ignition::common::Console::SetVerbosity(1);
  const double initial_megabytes = peak_megabytes();
  const auto start = std::clock();
  for (int i = 1; i < argc; ++i)
    if (ignition::common::MeshManager::Instance()->Load(argv[i]) == nullptr)
    {
      std::cerr << argv[i] << " can't be loaded" << std::endl;
      return 1;
    }
  const double seconds = double(std::clock() - start) / CLOCKS_PER_SEC;
  std::cout << "{\"seconds\": " << seconds << ", \"megabytes\": " << peak_megabytes() - initial_megabytes << "}"
            << std::endl;
  return 0;
}
