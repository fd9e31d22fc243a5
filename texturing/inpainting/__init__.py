"""Inpainting: colours for the surface that no photo shows.

`hole_filling` fills the holes of a page, `ground` inpaints the ground in an orthophoto over all pages, `patch_offsets`
is the inpainting algorithm (He and Sun 2012), `point_colours` takes colours from the point cloud.
"""
