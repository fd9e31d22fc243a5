"""Tracks and scenarios compared with ground truth: `python -m bench.scenario` (docs/scenarios.md)."""
