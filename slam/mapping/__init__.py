"""The map that odometry works with: keyframes and points, and the optimized window over them.

Start reading at `local_map`. The optimization problem is in `slam.factor_graph`, its solvers are in `slam.solvers`;
corrections of the finished map are in `slam.global_map`.
"""
