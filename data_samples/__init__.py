"""A synthetic street with its ground truth: generator, and one small committed tile."""

from pathlib import Path

SMALL = Path(__file__).parent / "tile"
"""The small committed tile."""
