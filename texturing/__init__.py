"""Mesh and photos to a textured mesh."""
