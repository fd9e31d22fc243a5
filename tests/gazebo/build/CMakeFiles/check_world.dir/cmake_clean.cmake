file(REMOVE_RECURSE
  "CMakeFiles/check_world.dir/check_world.cpp.o"
  "CMakeFiles/check_world.dir/check_world.cpp.o.d"
  "check_world"
  "check_world.pdb"
)

# Per-language clean rules from dependency scanning.
foreach(lang CXX)
  include(CMakeFiles/check_world.dir/cmake_clean_${lang}.cmake OPTIONAL)
endforeach()
