"""Removal of dynamic objects: what moved while the street was scanned, and the recording vehicle itself.

Begin with `free_space` (voxels that later rays pass through); `ego_vehicle_mask` finds points of the recording vehicle,
`vehicle_residue` measures what removed vehicles left behind. The step is `pipeline.steps.carve`.
"""
