"""The main job beside the obvious chain of libraries: `python -m bench.tile`."""
