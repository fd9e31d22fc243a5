"""Visual odometry: estimates the camera pose of each video frame in turn (D3.2, section 4.1).

Start reading at `odometry` (what happens to one frame). `video_odometry` runs it over a video with checkpoints,
`slam.virtual_cameras` cuts 360-degree frames into virtual views, `relocalization` finds the pose after tracking was
lost.
"""
