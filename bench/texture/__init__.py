"""Benchmarks of texturing: `python -m bench.texture`."""
