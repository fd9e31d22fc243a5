"""Steps from a video to a trajectory (D3.2, section 4.1), one module each; `flows/pipelines/video.py` chains them."""
