"""Terrain: the ground's heights fitted to its points, friction by class, low-poly plants.

Begin with `ground_fit`, which the step `pipeline.steps.ground` uses.
"""
