# Empty dependencies file for check_world.
# This may be replaced when dependencies are built.
