"""The map: keyframes and points, the factor graph over them, loop closure and global bundle adjustment.

Start reading at `local_map` (keyframes and the optimized window) and `factor_graph` (the optimization problem; its
solvers are in `slam.solvers`).
"""
