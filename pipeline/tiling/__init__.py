"""Tiling of surveys: where a long drive is cut, and how the meshes of neighbouring tiles meet.

Begin with `cut_plan` (seeds along the path) and `voronoi_cell` (the area of one tile); `cut_corridor` distributes
points and photos to tiles, `borders/` makes the meshes of neighbours meet vertex for vertex.
"""
