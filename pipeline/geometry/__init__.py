"""Geometry independent of classes: normals, planes, height maps, transforms, primitive shapes.

`planes` detects planes, `plane_boundaries` finds their polygons, `plane_snapping` moves a mesh onto them.
Kernels take arrays and numbers; they know no configuration and no step.
"""
