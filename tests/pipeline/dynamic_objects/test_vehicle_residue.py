"""Vehicle residue: area of a synthetic shell where a car stood, beside a wall and above the ground."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.dynamic_objects.vehicle_residue import residue_areas

FRAME = Frame("local", (100.0, 200.0, 30.0))


def plate(corner: tuple[float, float, float], a: tuple[float, float, float], b: tuple[float, float, float]) -> Mesh:
    """A parallelogram from a corner along two sides."""
    at = np.array(corner)
    places = np.array([at, at + a, at + np.add(a, b), at + b], np.float32)
    return Mesh(FRAME, places, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def write_instances(path: Path, *kinds: str, heading: float = 0.0) -> Path:
    """Write a file of instances of 4 x 2 x 1.5 m with a corner at the origin, turned by `heading` (radians)."""
    c, s = np.cos(heading), np.sin(heading)
    ring = np.array([[0, 0], [4, 0], [4, 2], [0, 2], [0, 0]]) @ np.array([[c, s], [-s, c]]) + FRAME.origin[:2]
    properties = {"ground_z": FRAME.origin[2], "height_m": 1.5}
    features = [
        {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
         "properties": {"kind": kind, **properties}} for kind in kinds
    ]  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
    return path


@pytest.mark.parametrize("heading", [0.0, 0.6])
def test_area_of_a_shell_where_a_car_stood_is_measured(tmp_path: Path, heading: float) -> None:
    c, s = np.cos(heading), np.sin(heading)
    side = plate((1 * c - 1 * s, 1 * s + 1 * c, 0.5), (2 * c, 2 * s, 0), (0, 0, 0.8))  # 2 x 0.8 m along its middle
    (left,) = residue_areas([side], write_instances(tmp_path / "instances.geojson", "car", heading=heading))
    assert left == pytest.approx(1.6, rel=0.05)


def test_ground_walls_and_crowns_are_not_vehicle_residue(tmp_path: Path) -> None:
    ground = plate((-5, -5, 0.1), (20, 0, 0), (0, 20, 0))
    wall = plate((-5, 1.95, 0), (20, 0, 0), (0, 0, 4))
    crown = plate((-5, -5, 3), (20, 0, 0), (0, 20, 0))
    assert residue_areas([ground, wall, crown], write_instances(tmp_path / "instances.geojson", "car", "person")) == [0]
