"""Benchmarks of segmentation: `python -m bench.segmentation`."""
