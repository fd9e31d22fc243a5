"""Pose refinement: photo poses adjusted so that all photos agree on the surface.

`step` is the pipeline step; `matches` finds correspondences on the surface, `bundle_adjustment` solves for all poses.
"""
