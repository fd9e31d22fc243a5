"""Ground synthesized where cars or low walls occluded it, compared with the true ground of a street."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import UNCOLOURED, Frame, PointCloud
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.ground import GROUND, GroundParams

FRAME = Frame("local", (100.0, 200.0, 30.0))
CAR, SHADOW, COURT, EDGE = (0, 0, 4, 2), (-8, -3, -2, -1), (6, 6, 16, 16), (-20, 10, -12, 20)
SAMPLE = Path(__file__).resolve().parents[3] / "data_samples" / "tile"


def true(xy: np.ndarray) -> np.ndarray:
    return 0.04 * xy[:, 0] - 0.01 * xy[:, 1]


def within(xy: np.ndarray, box: tuple[float, ...], by: float = 0.0) -> np.ndarray:
    low, high = np.array(box[:2]) - by, np.array(box[2:]) + by
    return np.all((xy > low) & (xy < high), axis=1)


def scanned(holes: tuple[tuple[float, ...], ...]) -> PointCloud:
    x, y = np.meshgrid(np.arange(-19.95, 20, 0.1), np.arange(-19.95, 20, 0.1))
    xy = np.column_stack([x.ravel(), y.ravel()])
    xy = xy[~np.any([within(xy, box) for box in holes], axis=0)]
    xyz = np.column_stack([xy, true(xy)]).astype(np.float32)
    n = len(xyz)
    return PointCloud(
        FRAME, xyz, np.full((n, 3), 90, np.uint8), np.tile(np.array([0, 0, 1], np.float32), (n, 1)),
        np.full(n, CODE["road"], np.uint8),
    )  # fmt: skip


def write_instances(path: Path, *, moved: bool = False) -> Path:
    x0, y0, x1, y1 = CAR
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]) + FRAME.origin[:2]
    feature = {"type": "Feature", "properties": {"kind": "car", "moved": moved}}
    feature["geometry"] = {"type": "Polygon", "coordinates": [ring.tolist()]}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")
    return path


def synthesized_ground(
    folder: Path, holes: tuple[tuple[float, ...], ...], *, moved: bool = False, gap: float = 1.5
) -> PointCloud:
    cloud, nothing = scanned(holes), scanned(((-30, -30, 30, 30),))
    files = {"terrain": cloud, "building": nothing, "vegetation": nothing, "rest": nothing}
    inputs = {name: folder / f"{name}.npz" for name in files}
    for name, part in files.items():
        part.save(inputs[name])
    inputs["instances"] = write_instances(folder / "instances.geojson", moved=moved)
    done = GROUND.run(inputs, GroundParams(gap=gap), folder, silent)
    return PointCloud.load(done.files["synthesized"])


def test_ground_is_extended_below_cars_and_behind_walls(tmp_path: Path) -> None:
    made = synthesized_ground(tmp_path, (CAR, SHADOW))
    for hole in (CAR, SHADOW):
        there = within(made.xyz[:, :2], hole)
        area = (hole[2] - hole[0]) * (hole[3] - hole[1])
        assert there.sum() * 0.01 == pytest.approx(area, rel=0.15)
    assert np.abs(made.xyz[:, 2] - true(made.xyz[:, :2])).max() < 0.02
    assert within(made.xyz[:, :2], CAR, 0.2).sum() + within(made.xyz[:, :2], SHADOW, 0.2).sum() == len(made)
    assert made.rgb is not None and (made.rgb == UNCOLOURED).all()  # texturing decides on the colour


def test_courtyards_and_areas_beyond_the_scan_stay_open(tmp_path: Path) -> None:
    made = synthesized_ground(tmp_path, (COURT, EDGE)).xyz[:, :2]
    assert within(made, COURT, -1.0).sum() == 0 and within(made, EDGE, -1.0).sum() == 0  # only corners are rounded


def test_no_ground_is_synthesized_where_vehicles_drove(tmp_path: Path) -> None:
    wide = (
        CAR[0] - 20,
        CAR[1] - 3,
        CAR[2] + 20,
        CAR[3] + 3,
    )  # a street's width that is missing in the scan, through the tile
    assert len(synthesized_ground(tmp_path, (wide,), moved=True)) == 0


def test_gaps_wider_than_the_setting_stay_open(tmp_path: Path) -> None:
    through = (-30, -2, 30, 1)
    assert len(synthesized_ground(tmp_path, (through,), moved=True, gap=1.0)) == 0
    assert len(synthesized_ground(tmp_path, (through,), moved=True, gap=2.0)) > 10_000


def test_ground_task_can_be_disabled() -> None:
    tile = read_tile(SAMPLE)
    assert "ground" in {task.full_name for task in build_graph(tile, Settings())}
    assert "ground" not in {task.full_name for task in build_graph(tile, Settings({"ground": {"when": "never"}}))}
