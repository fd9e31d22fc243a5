"""Visual odometry: frames to poses, one after the other (D3.2, section 4.1).

Begin with `odometry` (what happens to a frame); `video_odometry` runs it over a video with checkpoints,
`virtual_cameras` cuts 360-degree frames into pinhole views, `relocalization` finds the pose after a loss of tracking.
"""
