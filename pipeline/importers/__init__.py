"""Importers: convert recordings and projects of other programs to tiles.

One workflow each: `kitti_raw`, `kitti_odometry`, `sweeps`, `bag` and `datasets` (ROS bags; nuScenes, PandaSet: both are
unpacked for `sweeps`), `clouds_and_photos`, `robot_map`, `photogrammetry` (COLMAP, nerfstudio, ..., whose depth images
`depth_images` fuses).
Those of lidar sweeps share `place_sweeps` (with `deskew`, `scanner_path`, `point_colours`). File formats are read by
`pipeline.io`; importers don't estimate poses.
"""
