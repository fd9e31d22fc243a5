"""Benchmarks of teleoperation: `python -m bench.teleop`."""
