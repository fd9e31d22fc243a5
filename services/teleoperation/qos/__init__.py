"""Quality of service of teleoperation, measured in scripted drives.

Begin with `measure`.
"""
