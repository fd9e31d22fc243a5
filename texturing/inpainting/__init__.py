"""Inpainting: colours for the surface that no photo shows.

`hole_filling` fills a page, `ground` plans the ground's texture over all pages, `patch_offsets` continues its pattern
(He and Sun 2012), `point_colours` takes colours from the cloud.
"""
