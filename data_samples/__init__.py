"""Generators of synthetic streets, drives and crossings with ground truth, and a small committed tile."""

from pathlib import Path

SMALL = Path(__file__).parent / "tile"
"""The small committed tile."""
