"""Borders between tiles that were built independently: clipping, matching and joining of meshes to shared vertices."""
