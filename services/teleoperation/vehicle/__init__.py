"""The vehicle's programs: the onboard unit and the adapter that drives a kind of vehicle.

Begin with `onboard_unit`; `adapters/` holds one file for each kind of vehicle.
"""
