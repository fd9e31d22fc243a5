"""Autoscaling: how many workers a queue needs, and what starts them.

Begin with `policy`; `actuators/` start workers as local processes, through Prefect or through OSM.
"""
