// Loads meshes as Gazebo does, and says how long it took and how much memory.
//
//   load_meshes FILE ...
//
// Prints one line of JSON: seconds, and the megabytes by which the process has grown.

#include <chrono>
#include <fstream>
#include <iostream>
#include <string>

#include <unistd.h>

#include <ignition/common/Console.hh>
#include <ignition/common/Mesh.hh>
#include <ignition/common/MeshManager.hh>

double megabytes()
{
  long size = 0, resident = 0;
  std::ifstream("/proc/self/statm") >> size >> resident;
  return resident * sysconf(_SC_PAGESIZE) / 1e6;
}

int main(int argc, char **argv)
{
  ignition::common::Console::SetVerbosity(1);
  const double before = megabytes();
  const auto began = std::chrono::steady_clock::now();
  for (int i = 1; i < argc; ++i)
    if (ignition::common::MeshManager::Instance()->Load(argv[i]) == nullptr)
    {
      std::cerr << argv[i] << " can't be loaded" << std::endl;
      return 1;
    }
  const std::chrono::duration<double> took = std::chrono::steady_clock::now() - began;
  std::cout << "{\"seconds\": " << took.count() << ", \"megabytes\": " << megabytes() - before << "}" << std::endl;
  return 0;
}
