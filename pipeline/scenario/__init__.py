"""Scenarios: the road users that were recorded, driving again in the world (OpenSCENARIO, Gazebo).

From tracks (`pipeline.tracking`) to actors with shapes (`scenario`, `shapes`), their check (`motion_check`) and their
variation by seed (`variation`). Writers of files: `pipeline.io.scenario_formats`.
"""
