"""Importers: convert recordings and projects of other programs to tiles.

One workflow each: `kitti_raw`, `kitti_odometry`, `sweeps`, `photogrammetry` (COLMAP, OpenSfM, Metashape ...),
`clouds_and_photos`. File formats are read by `pipeline.io`; importers don't estimate poses.
"""
