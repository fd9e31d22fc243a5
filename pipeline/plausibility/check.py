"""All checks of a tile's plausibility."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.plausibility import cameras, classes, cloud
from scan2sim.pipeline.plausibility.finding import Finding
from scan2sim.pipeline.pose_check.photo_fit import sample_points

MIN_POINTS = 1000
"""Fewer points aren't judged."""


def check_tile(path: Path) -> list[str]:
    """Findings about the tile of a `tile.toml`, the worst first; also if the check fails."""
    try:
        return find_implausible(read_tile(path))
    except Exception as error:  # the check must not cost the import
        return [f"the plausibility of the tile couldn't be checked ({type(error).__name__}: {error})"]


def find_implausible(tile: Tile) -> list[str]:
    """Findings about a tile, the worst first.

    Raises:
        ScanError: a cloud can't be read.
    """
    points = sample_points(tile)
    if len(points) < MIN_POINTS:
        return []
    found: list[Finding | None] = [cloud.coordinate_steps(points, tile.frame.unit)]
    if tile.robot_map is None:  # robots' maps are turned, scaled and cleaned by their import
        found += [
            cloud.far_points(points),
            cloud.density(points, sum(clouds.read_header(path).count for path in tile.clouds)),
            cloud.level_ground(points),
            classes.ground_classes(points),
        ]
    views = [view for view in tile.views if view.camera.model != "orthographic"]
    found += [cameras.distance(views, points), cameras.heights(views, points)]
    return [one.text for one in sorted(filter(None, found), key=lambda one: -one.severity)]
