"""Files for navigation with ROS 2 beside a world: Nav2's occupancy maps, a PCD for localization, a launch file."""
