"""The camera: given, read from metadata or estimated; whether a lens fits the images.

Begin with `camera`; `lens` checks and estimates intrinsics, `calibrate` does so over a whole drive.
"""
