"""Tile borders: colour harmonization between neighbouring tiles, and its evaluation."""
