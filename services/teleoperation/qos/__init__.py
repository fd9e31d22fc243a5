"""Quality of service of teleoperation, measured in scripted drives.

Begin with `measure`; `route` is the reference path and its driver.
"""
