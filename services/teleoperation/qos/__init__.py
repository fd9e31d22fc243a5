"""Quality of service of teleoperation, measured by scripted drives.

Begin with `measure`.
"""
