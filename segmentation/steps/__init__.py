"""The steps of segmentation, one file each.

`label` (photos to class probabilities per pixel), `segment` (to a class per point), `instances` (vehicles and people),
`signs` (sign panels fitted to photos).
"""
