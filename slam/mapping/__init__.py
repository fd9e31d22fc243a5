"""The map: keyframes and points, the factor graph over them, loop closure and global adjustment.

Begin with `local_map` (keyframes and the window that is optimised) and `factor_graph` (the problem; solvers are in
`slam.solvers`).
"""
