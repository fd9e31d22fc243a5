"""scan2sim: street scans to textured, lightweight worlds for robot simulators.

The rooms stand at the top of the repository. Links here (in the wheel: the folders themselves) give them one name,
`scan2sim.<room>`, in a checkout and installed, whatever else is called `pipeline` or `flows` on a user's path.
"""

__version__ = "0.1.0"
