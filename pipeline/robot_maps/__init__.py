"""Maps of robots: what a point cloud without photos or trajectory shows of its units, noise, scene and outliers.

Begin with `describe.py`; `pipeline/importers/robot_map.py` makes a tile of a map with it.
"""
