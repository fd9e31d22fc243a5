"""Tracking: boxes of vehicles and people through the sweeps of a scanner (docs/scenarios.md).

`assemble` makes the tracks of a tile: `follow` follows what moves (`association` by `kalman`, boxes by `fit`), `parked`
fits a box to each parked vehicle, both by `extents` and `sizes`; `overlaps` keeps boxes apart. `tracks` defines a track
and its files, `scoring_formats` writes the formats of KITTI and nuScenes.
"""
