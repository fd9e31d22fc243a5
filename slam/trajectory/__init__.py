"""Trajectories: alignment to GPS, scale correction, sensor fusion, evaluation against ground truth, output.

Start reading at `align` (upright, scaled, georeferenced). `fusion` is the pose graph over sweeps, video and GPS.
"""
