"""Trajectories: aligned to GPS, scaled, fused with other sensors, evaluated against ground truth, written.

Begin with `align` (upright, scaled, georeferenced); `fusion` is the pose graph over sweeps, video and GPS.
"""
