"""Terrain: fitting of ground heights to points, friction by class, low-poly plants.

Begin with `ground_fit`, which the step `pipeline.steps.collision` uses.
"""
