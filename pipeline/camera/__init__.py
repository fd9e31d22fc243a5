"""Cameras: projection, depth maps and visibility, image sampling, rendering; kernels shared by all packages.

Begin with `models` (camera models) and `projection` (points to pixels, with visibility by `depth_map`).
`photo_coverage` measures the ground sample distance of points in the photos.
"""
