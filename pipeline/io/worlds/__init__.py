"""Finished worlds: the scene that exports are made from, and the writers of SDF, GLB and FBX.

Begin with `scene` (what a finished world holds); `merge` puts the worlds of tiles into one.
Formats that a user chooses are in `pipeline.io.world_formats`.
"""
