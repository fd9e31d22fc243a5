"""Importer of ROS bags: ROS 2 (MCAP, SQLite) and ROS 1, without ROS.

`reader` opens a bag, `contents` lists what is in it, `plan` decides what each topic is used for, and `unpack` writes
sweeps, photos, calibration and poses in the layout that `pipeline.importers.sweeps` reads. Messages are decoded by
`point_cloud2`, `livox`, `images` and `cameras`; `transforms` chains frames, `poses` makes a trajectory.
"""
