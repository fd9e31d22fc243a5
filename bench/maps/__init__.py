"""Worlds made from robots' maps, measured against ground truth."""
