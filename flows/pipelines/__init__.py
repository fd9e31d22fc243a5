"""Pipeline definitions: the task graphs of a tile, a survey, a video and a drive, and the settings of their steps."""
