"""Camera intrinsics: given by the user, read from metadata, or estimated by self-calibration.

Start reading at `camera`. `slam.lens` checks and estimates intrinsics from turns, `calibrate` does so over a
whole drive.
"""
