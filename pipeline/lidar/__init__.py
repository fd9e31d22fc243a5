"""Lidar: compares the recorded sweeps of a scanner with those that it would record in the world.

`sweeps` finds the sweeps in a cloud and the scanner's position at each return, `casting` casts their rays through
meshes, `range_errors` compares the ranges by surface and distance, `unreturned` reconstructs rays without a return,
`phantoms` counts surface where recorded rays passed on, `range_image` computes the measures of the
literature. The steps are `pipeline.steps.sweeps` and `pipeline.steps.lidar_score`.
"""
