"""Finished worlds: the scene from which exports are written, and the writers of SDF, GLB and FBX.

Start reading at `scene` (content of a finished world); `merge` combines the worlds of tiles.
The export formats that a user selects are in `pipeline.io.world_formats`.
"""
