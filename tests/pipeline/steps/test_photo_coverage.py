"""Photo coverage selects the points that get a surface: a synthetic street with a camera that drives ahead."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import build_survey_graph
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, UNCOLOURED, Camera, Frame, PointCloud, Tile, Trajectory, View
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.steps.photo_coverage import CLOSING_CELL_M, PHOTO_COVERAGE, ROADSIDE_M
from tests.fakes.steps import step_params

CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 600.0, 200.0)


def plane(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> F32:
    """Points on an axis-parallel rectangle, a decimetre apart."""
    axes = [np.arange(low, high, 0.1) if high > low else np.array([low]) for low, high in (x, y, z)]
    return np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1).astype(np.float32)


GROUND = plane((-30, 60), (-20, 20), (0, 0))
WALL = plane((0, 40), (8, 8), (0, 3))  # along the street
SCREEN = plane((12, 12), (-7, -6), (0, 1.2))  # small, across the street: occludes the ground behind
PARTS = {"road": GROUND, "building": WALL, "wall_or_fence": SCREEN}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive of 10 m along x, with a photo every 2 m that looks ahead."""
    out = tmp_path_factory.mktemp("street")
    classification = np.concatenate([np.full(len(xyz), CODE[name], np.uint8) for name, xyz in PARTS.items()])
    PointCloud(Frame(), np.concatenate(list(PARTS.values())), classification=classification).save(out / "cloud.npz")
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses[:, :3, 3] = np.column_stack([np.arange(0, 12, 2), np.zeros(6), np.full(6, 1.7)])
    views = [View(str(i), CAMERA, pose, Path(f"{i}.jpg")) for i, pose in enumerate(poses)]
    views_io.save(out / "views.json", views, [False] * len(views))
    Trajectory(np.arange(6.0), poses[:, :3, 3]).save(out / "path.npz")
    return {"cloud": out / "cloud.npz", "views": out / "views.json", "path": out / "path.npz"}


def left(done: Done) -> PointCloud:
    return PointCloud.load(done.files["cloud"])


def go(inputs: dict[str, Path], out: Path, **params: Any) -> Done:
    return PHOTO_COVERAGE.run(inputs, step_params(PHOTO_COVERAGE.params, **params), out, silent)


def test_covered_points_and_the_lane_are_kept_and_others_removed(street: dict[str, Path], tmp_path: Path) -> None:
    done = go(street, tmp_path)
    cloud = left(done)
    x, y, z = cloud.xyz.T
    ground = cloud.classification == CODE["road"]
    assert ((x > 15) & (x < 25) & (abs(y) < 5) & ground).sum() > 0.97 * 100 * 100, "ahead"
    behind = ground & (x < -1)
    assert behind.any() and np.hypot(x[behind], y[behind]).max() < ROADSIDE_M + 1.5 * CLOSING_CELL_M, (
        "only the lane behind the first photo"
    )
    assert not (y > 9).any(), "points behind the wall"
    assert ((x > 10) & (x < 25) & (y > 7.9) & (y < 8.1) & (z > 0.2)).sum() > 0.95 * 150 * 28, "the wall itself"
    assert done.metrics["left_out"] == done.metrics["points_in"] - len(cloud) > 0
    lost = len(np.concatenate(list(PARTS.values()))) - len(cloud)
    assert done.metrics["left_out_m2"] == pytest.approx(lost * 0.01, rel=0.1)


def test_uncovered_points_are_thinned_by_class(street: dict[str, Path], tmp_path: Path) -> None:
    done = go(street, tmp_path)
    covered, thin = left(done), PointCloud.load(done.files["uncovered"])
    removed = sum(map(len, PARTS.values())) - len(covered)
    assert removed / 12 < len(thin) == done.metrics["coarse"] < removed / 6
    x, y, z = thin.xyz.T
    assert thin.classification is not None and thin.normal is not None
    assert (thin.classification[(y > 7.5) & (y < 8.5) & (z > 0.5)] == CODE["building"]).all()
    ground = thin.classification == CODE["road"]
    assert (thin.normal[ground, 2] > 0.99).all()
    behind = ground & (x > -29) & (x < -5) & (abs(y) < 19)
    cells = np.unique(np.floor(np.column_stack([x, y])[behind]), axis=0)
    assert len(cells) > 0.98 * 24 * 38, "the street behind the first photo is there"


def test_uncovered_points_can_be_removed(street: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "coarse").mkdir()
    done, coarse = go(street, tmp_path, uncovered="remove"), go(street, tmp_path / "coarse")
    assert len(PointCloud.load(done.files["uncovered"])) == 0
    np.testing.assert_array_equal(left(done).xyz, left(coarse).xyz)


def test_uncovered_points_without_colours_get_those_of_their_class(street: dict[str, Path], tmp_path: Path) -> None:
    cloud = PointCloud.load(street["cloud"])
    x = cloud.xyz[:, 0]
    rgb = np.where((x > 0)[:, None], [90, 100, 110], UNCOLOURED).astype(np.uint8)
    intensity = (1000 + 100 * (np.arange(len(x)) % 7)).astype(np.uint16)
    for name, one in (("classes", None), ("intensity", intensity)):
        (tmp_path / name).mkdir()
        replace(cloud, rgb=rgb, intensity=one).save(tmp_path / name / "in.npz")
        done = go(street | {"cloud": tmp_path / name / "in.npz"}, tmp_path / name)
        thin = PointCloud.load(done.files["uncovered"])
        assert thin.coloured.all() and thin.rgb is not None
        behind = thin.rgb[thin.xyz[:, 0] < -10].astype(float)
        np.testing.assert_allclose(np.median(behind, axis=0), [90, 100, 110], atol=15)


def test_ground_occluded_by_a_small_object_is_kept(street: dict[str, Path], tmp_path: Path) -> None:
    cloud = left(go(street, tmp_path))
    x, y, _ = cloud.xyz.T
    shadow = (x > 12.1) & (x < 13.5) & (y > -7) & (y < -6) & (cloud.classification == CODE["road"])
    assert shadow.sum() > 0.95 * 13 * 9


def test_limit_is_the_distance_from_the_path(street: dict[str, Path], tmp_path: Path) -> None:
    done = go(street, tmp_path, limit=6.0)
    assert len(PointCloud.load(done.files["uncovered"])) == 0
    x, y, _ = left(done).xyz.T
    away = np.hypot(x - x.clip(0, 10), y)
    assert 5.5 < away.max() < 6.6 and done.metrics["far_m"] < 6.6


def test_held_out_photos_are_ignored(street: dict[str, Path], tmp_path: Path) -> None:
    views_io.save(tmp_path / "views.json", views_io.load(street["views"]), [True] * 6)
    x, y, _ = left(go(street | {"views": tmp_path / "views.json"}, tmp_path)).xyz.T
    assert np.hypot(x - x.clip(0, 10), y).max() < ROADSIDE_M + 1.5 * CLOSING_CELL_M


def test_airborne_paths_and_tiles_without_photos_keep_all_points(street: dict[str, Path], tmp_path: Path) -> None:
    path = Trajectory.load(street["path"])
    replace(path, positions=path.positions + [0, 0, 50]).save(tmp_path / "path.npz")
    for i, inputs in enumerate((street | {"path": tmp_path / "path.npz"}, {"cloud": street["cloud"]})):
        (tmp_path / str(i)).mkdir()
        done = go(inputs, tmp_path / str(i))
        assert done.metrics["left_out"] == 0 and len(left(done)) == len(PointCloud.load(street["cloud"]))


def test_step_exists_only_with_photos_along_a_path() -> None:
    view = View("a", CAMERA, np.eye(4), Path("a.jpg"))
    bare = Tile(Path("tile.toml"), "a", Frame(), (Path("cloud.laz"),))
    street = replace(bare, views=(view,))
    steps = {
        name: {task.step.name for task in build_graph(tile, Settings())} for name, tile in (("b", bare), ("s", street))
    }
    assert "photo_coverage" in steps["s"] and "photo_coverage" not in steps["b"]
    off = {task.step.name for task in build_graph(street, Settings({"photo_coverage": {"limit": "off"}}))}
    assert "photo_coverage" not in off
    # neighbouring tiles select equal points at their border, with or without photos
    tiles = [
        replace(street, name="a", cell=Cell((0, 0), {"b": (10, 0)})),
        replace(bare, name="b", cell=Cell((10, 0), {"a": (0, 0)})),
    ]
    tasks = {task.full_name: task for task in build_survey_graph(tiles, Settings())}
    read = {(source.task.full_name, source.name) for source in tasks["a/overlap"].inputs.values()}  # type: ignore[union-attr]
    assert read == {("a/photo_coverage", "cloud"), ("b/photo_coverage", "cloud")}
    coarse = tasks["a/overlap.uncovered"].inputs.values()
    assert {source.task.full_name for source in coarse} == {"a/photo_coverage", "b/photo_coverage"}  # type: ignore[union-attr]
