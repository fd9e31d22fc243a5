"""Plausibility of a tile: what its points and cameras can't be if it was read as its owner means it.

`check` runs all checks and names the worst finding first; `cloud` and `cameras` have them. Every import ends with it,
and `scan2sim inspect` prints it.
"""
