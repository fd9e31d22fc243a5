"""The whole map after odometry: its checkpoint file, covariances, loop closure and global bundle adjustment.

Start reading at `map_file`. `sparse_model` gives all points and observations, for export and for `global_adjustment`.
"""
