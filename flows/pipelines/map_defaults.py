"""Defaults of settings for tiles made from robots' maps: lengths follow the spacing of the map's points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from scan2sim.pipeline.core.types import RobotMap

DENSE_SPACING_M = 0.1
"""Spacing up to which the defaults of all other tiles hold (voxels of 10 cm)."""
VOXEL_SPACINGS = 0.9
"""Voxel size, as a multiple of the spacing: hardly any point of a map on a grid is merged with another."""
VOXEL_MAX_M = 1.0
ISLAND_POINTS, TERRAIN_ISLAND_POINTS = 15, 40
"""Size of the smallest piece of surface that is kept, in points of the map."""
TEXEL_SPACINGS = 0.4
"""Texel size, as a multiple of the spacing of the points that colour the texels."""
TEXEL_MIN_M, TEXEL_MAX_M = 0.03, 0.2
VEGETATION_TEXELS = 3.0
"""Texel size of vegetation, as a multiple."""


def map_defaults(robot_map: RobotMap | None) -> Mapping[str, Mapping[str, Any]]:
    """Settings by step and class, as in `Settings.values`; empty without a map, and indoors.

    Poisson's depth and the limits of step `trim` follow the voxel size and the spacing by themselves.
    """
    if robot_map is None or robot_map.scene != "outdoor":
        return {}
    spacing = robot_map.spacing
    texel = round(min(max(TEXEL_SPACINGS * spacing, TEXEL_MIN_M), TEXEL_MAX_M), 3)
    defaults: dict[str, dict[str, Any]] = {
        "unwrap": {
            "texel": texel,
            "unseen_texel_factor": 1.0,  # no photo sees anything
            "vegetation": {"texel": round(VEGETATION_TEXELS * texel, 3)},
        }
    }
    if VOXEL_SPACINGS * spacing > DENSE_SPACING_M:
        area = spacing**2
        defaults["voxel"] = {"size": min(math.ceil(100 * VOXEL_SPACINGS * spacing) / 100, VOXEL_MAX_M)}
        defaults["islands"] = {
            "min_area": round(max(0.5, ISLAND_POINTS * area), 2),
            "terrain": {"min_area": round(max(2.0, TERRAIN_ISLAND_POINTS * area), 2)},
        }
    return defaults
