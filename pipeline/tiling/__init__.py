"""Tiling of surveys: cutting of a long drive into tiles, and stitching of the meshes of neighbouring tiles.

Start reading at `cut_plan` (seeds along the path) and `voronoi_cell` (the area of one tile); `cut_corridor` distributes
points and photos to tiles, `borders/` makes the meshes of neighbours share the vertices of their borders.
"""
