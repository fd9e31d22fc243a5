"""GeoJSON of tracks."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.geodata import track_geojson
from scan2sim.pipeline.tracking.tracks import Track

FRAME = Frame("EPSG:32632", (458_800.0, 5_428_600.0, 110.0))


def test_geojson_has_boxes_and_paths_in_the_crs(tmp_path: Path) -> None:
    poses = np.column_stack([np.arange(5) / 3, np.full(5, 2.0), np.full(5, -1.7), np.full(5, 0.1)])
    car = Track(
        3,
        "car",
        (4.2, 1.8, 1.5),
        np.arange(5, dtype=np.float64) / 10,
        poses,
        np.full((5, 2), 0.05),
        True,
        (200, 10, 30),
    )
    van = replace(car, id=7, category="van", times=car.times[:1], poses=poses[:1], sigma=car.sigma[:1], moving=False)
    track_geojson.write(tmp_path / "tracks.geojson", [car, van], FRAME)
    body = json.loads((tmp_path / "tracks.geojson").read_text())
    kinds = [(f["properties"]["id"], f["geometry"]["type"]) for f in body["features"]]
    assert kinds == [(3, "Polygon"), (3, "LineString"), (7, "Polygon")]
    assert body["features"][1]["geometry"]["coordinates"][0] == pytest.approx([458_800, 5_428_602, 108.3])
    assert body["features"][0]["properties"]["speed_mps"] == pytest.approx(3.33, abs=0.01)
    assert body["features"][0]["properties"]["colour"] == "#c80a1e"
