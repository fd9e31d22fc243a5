"""Optical flow: what trackers need beside Lucas-Kanade.

`exposure` compensates gain and offset between two frames, `patch_alignment` refines a track by its first template.
"""
