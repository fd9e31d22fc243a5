"""Benchmarks of the event bus: `python -m bench.bus`."""
