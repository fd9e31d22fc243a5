"""Pipeline steps of the segmentation, one file each.

`label` (class probabilities per pixel of the photos), `segment` (a class per point), `instances` (vehicles and people),
`signs` (sign panels fitted to photos).
"""
