"""Benchmarks of SLAM: `python -m bench.slam`."""
