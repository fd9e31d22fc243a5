"""Real streets: static objects misclassified as vehicles in photos, and traffic in few sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from tests.flows.command import scan2sim, stdout_of

pytestmark = pytest.mark.slow


class Place(NamedTuple):
    """Upright cylinder in the CRS: object in it, centre and radius in metres, and lowest height above the ground."""

    what: str
    x: float
    y: float
    radius: float
    low: float


STREETS: dict[str, tuple[tuple[str, ...], list[Place], list[Place]]] = {
    "kitti_raw0013_f62-83": (
        ("kitti-raw",),
        [
            Place("white slabs of stone behind a fence", 458876.8, 5429157.7, 2.5, 0.5),
            Place("trunk of a tree on the verge", 458856.0, 5429160.4, 0.5, 0.5),
        ],
        [
            Place("car ahead at the end of the drive", 458858.1, 5429178.5, 1.5, 0.5),
            Place("car that follows", 458879.5, 5429122.8, 2.0, 0.5),
        ],
    ),
    "kitti_odo04_f00-24": (
        ("kitti-odometry",),
        [],
        [Place("van ahead, seen by the last two sweeps", 52.6, -0.3, 2.0, 0.5)],
    ),
}
"""By recording: arguments of its import, places of what stays, and of what passes."""


@pytest.mark.parametrize("name", STREETS)
def test_static_objects_are_kept_and_traffic_is_removed(real_data: Path, tmp_path: Path, name: str) -> None:
    importing, stays, passes = STREETS[name]
    stdout_of(scan2sim("import", *importing, real_data / name, "--out", tmp_path / "tile", timeout=900))
    stdout_of(scan2sim("segment", tmp_path / "tile", "--out", tmp_path / "out", timeout=900))
    cloud = laspy.read(next((tmp_path / "out").rglob("*.laz")))
    xyz, code = np.stack([cloud.x, cloud.y, cloud.z], axis=1), np.asarray(cloud.classification)
    for place in stays:
        assert vehicles_in(place, xyz, code) < 0.1, place.what
    for place in passes:
        assert vehicles_in(place, xyz, code) > 0.9, place.what


def vehicles_in(place: Place, xyz: np.ndarray, code: np.ndarray) -> float:
    """Share of the points in a place, above its ground, that are classified as vehicle."""
    near = np.hypot(xyz[:, 0] - place.x, xyz[:, 1] - place.y) < place.radius
    above = near & (xyz[:, 2] > np.percentile(xyz[near, 2], 2) + place.low)
    assert above.sum() > 20, f"{place.what}: the scan has no points there"
    return float((code[above] == CODE["vehicle"]).mean())
