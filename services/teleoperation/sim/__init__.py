"""A simulated vehicle in a finished world: rendering, vehicle dynamics, a scripted route, the demo.

Begin with `demo`.
"""
