"""Simulation assets: collision shapes, a small robot, a spawn pose in free space.

Begin with `collision_shapes`; the step is `pipeline.steps.collision`.
"""
