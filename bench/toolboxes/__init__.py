"""Benchmarks of the ML toolboxes: `python -m bench.toolboxes`."""
