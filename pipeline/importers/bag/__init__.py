"""Importer of ROS bags: ROS 2 (MCAP, SQLite) and ROS 1, without ROS.

`reader` opens a bag, `contents` lists what is in it, `plan` decides what each topic is used for (with `lidar_topics`,
`camera_topics` and `clocks`), and `unpack` writes sweeps, photos, calibration and poses in the layout that
`pipeline.importers.sweeps` reads. Messages are decoded by `point_cloud2`, `livox`, `images` and `cameras`, and checked
by `pose_messages`; `transforms` chains frames, `poses` makes a trajectory.
"""
