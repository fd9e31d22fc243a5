"""Importers of published data sets: `nuscenes` and `pandaset`.

Each reads the files of one drive into a `recording.Recording`, which is written in the layout that
`pipeline.importers.sweeps` reads: sweeps, photos of a rig, and the path of the scanner. Annotations aren't read.
"""
