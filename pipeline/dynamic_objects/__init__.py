"""Removal of dynamic objects: objects that moved during the scan, and the ego vehicle.

Begin with `free_space` (voxels that later rays pass through); `ego_vehicle_mask` finds returns of the ego vehicle,
`instance_boxes` selects points in the boxes of vehicles and people, `vehicle_residue` measures the surface that removed
vehicles left behind. The step is `pipeline.steps.dynamic_objects`.
"""
