"""A simulated vehicle in a finished world: rendering, vehicle dynamics, the demo.

Begin with `demo`.
"""
