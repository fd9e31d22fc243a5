"""Autoscaling: the number of workers that a queue needs, and the actuators that start them.

Begin with `policy`; `actuators/` start workers through Prefect or through OSM.
"""
