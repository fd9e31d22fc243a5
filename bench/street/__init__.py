"""Real streets, from raw data to a scored world: `python -m bench.street`."""
