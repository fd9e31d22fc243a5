"""Detection of a street's poles, signs and trunks at their true positions, without false positives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.data_samples import SMALL
from scan2sim.data_samples.layout import FRAME, lay_out
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Mesh, PointCloud, Trajectory
from scan2sim.pipeline.furniture.poles import Columns, stems
from scan2sim.pipeline.furniture.sign_panels import OUTLINES, Shape, detect_panels, inside
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.steps.decimate import DECIMATE, DecimateParams
from scan2sim.pipeline.steps.detect_furniture import DETECT_FURNITURE, DetectFurnitureParams
from scan2sim.pipeline.steps.furniture import FURNITURE, FurnitureParams
from scan2sim.pipeline.steps.split import SPLIT, SplitParams
from tests.fakes.steps import step_params


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The small street's cloud and its scanner's path."""
    from scan2sim.pipeline.io.clouds import read

    folder = tmp_path_factory.mktemp("street")
    read(SMALL / "cloud.laz", FRAME).save(folder / "cloud.npz")
    rows = np.loadtxt(SMALL / "trajectory.csv", delimiter=",", skiprows=1)
    Trajectory(rows[:, 0], rows[:, 1:] - FRAME.origin).save(folder / "path.npz")
    return folder / "cloud.npz", folder / "path.npz"


def _run(street: tuple[Path, Path], out: Path, **params: Any) -> tuple[list[dict[str, Any]], Done]:
    out.mkdir()
    cloud = {"cloud": street[0]}
    found = DETECT_FURNITURE.run(cloud | {"path": street[1]}, step_params(DetectFurnitureParams, **params), out, silent)
    done = FURNITURE.run(cloud | found.files, step_params(FurnitureParams, **params), out, silent)
    features = json.loads(done.files["geojson"].read_text(encoding="utf-8"))["features"]
    return [f["properties"] | {"at": np.array(f["geometry"]["coordinates"]) - FRAME.origin} for f in features], done


def test_street_furniture_is_detected_without_false_positives(street: tuple[Path, Path], tmp_path: Path) -> None:
    found, done = _run(street, tmp_path / "whole")
    layout = lay_out(26.0, 5)
    places, kinds = [], []
    for post in layout.posts:
        places.append(layout.axis.place(post.s, post.t)[0])
        kinds.append("pole" if post.sign is None else "sign")
    trees = [layout.axis.place(tree.s, tree.t)[0] for tree in layout.trees if not tree.bush]
    at = np.array([thing["at"][:2] for thing in found])
    for place, kind in zip(places, kinds, strict=True):
        near = np.hypot(*(at - place).T)
        thing = found[int(near.argmin())]
        assert near.min() < 0.05 and thing["kind"] in (kind, "lamp")
    for thing, place in zip(found, at, strict=True):  # each detection is a real object
        assert np.hypot(*(np.array([*places, *trees]) - place).T).min() < 0.3, thing
    assert sum(thing["kind"] == "trunk" for thing in found) >= len(trees) - 1  # one is at the end of the street
    # their points are removed from surfaces
    cloud = PointCloud.load(street[0])
    done = SPLIT.run(
        {"cloud": street[0], "furniture_points": done.files["furniture_points"]},
        SplitParams(),
        tmp_path / "whole",
        silent,
    )
    left = PointCloud.load(done.files["building"]).classification
    assert cloud.classification is not None and left is not None
    for code in (CODE["road_sign"], CODE["pole"]):
        assert (left == code).sum() < 0.25 * (cloud.classification == code).sum()  # points of the lamp's arm remain


def test_signs_have_their_heading_and_size(street: tuple[Path, Path], tmp_path: Path) -> None:
    found, _ = _run(street, tmp_path / "signs")
    layout = lay_out(26.0, 5)
    for post in layout.posts:
        if post.sign is None:
            continue
        place, heading = layout.axis.place(post.s, post.t)
        sign = min(found, key=lambda thing: float(np.hypot(*(thing["at"][:2] - place))))
        faces = np.degrees(heading) + (180 if post.towards == 1 else 0)
        off = (float(sign["heading_deg"]) - (90 - faces) + 180) % 360 - 180
        assert abs(off) < 3
        assert sign["shape"] == "rectangle"
        assert sign["panel_width_m"] == pytest.approx(0.72, abs=0.04)
        assert sign["panel_height_m"] == pytest.approx(0.72, abs=0.04)


def test_furniture_keeps_triangles_and_classes_in_decimation(tmp_path: Path) -> None:
    n = 120
    x, y = np.meshgrid(np.arange(n) / 10, np.arange(n) / 10)
    vertices = np.column_stack([x.ravel(), y.ravel(), np.sin(x.ravel())]).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.column_stack([a, a + 1, a + n + 1]), np.column_stack([a, a + n + 1, a + n])])
    Mesh(FRAME, vertices, faces.astype(np.int32)).save(tmp_path / "surface.npz")
    pole = primitives.tube([(5, 5, 0), (5, 5, 3)], [0.03, 0.03], 8)
    codes = np.full(len(pole[1]), CODE["pole"], np.uint8)
    Mesh(FRAME, pole[0].astype(np.float32), pole[1], classification=codes).save(tmp_path / "things.npz")
    inputs = {"mesh": tmp_path / "surface.npz", "furniture": tmp_path / "things.npz"}
    mesh = Mesh.load(DECIMATE.run(inputs, DecimateParams(target=10_000), tmp_path, silent).files["mesh"])
    assert len(mesh) <= 10_000 and mesh.classification is not None
    kept = mesh.keep(mesh.classification == CODE["pole"])
    assert len(kept) == len(codes) and kept.vertices[:, 2].max() == 3


def test_fences_walls_and_bushes_are_not_poles() -> None:
    rng = np.random.default_rng(0)

    def scattered(count: int, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
        return rng.uniform(low, high, (count, 3)) + rng.normal(0, 0.01, (count, 3))

    wall = scattered(30_000, (0, 0, 0.2), (6, 0, 3))
    bush = rng.normal((3, 4, 1), 0.4, (5000, 3))
    pickets = np.concatenate([scattered(200, (k / 4, 8, 0.2), (k / 4 + 0.08, 8, 1.0)) for k in range(20)])
    angle = rng.uniform(0, np.pi, 1500)
    pole = np.column_stack([9 + 0.04 * np.cos(angle), 3 + 0.04 * np.sin(angle), rng.uniform(0.2, 3, 1500)])
    xyz = np.concatenate([wall, bush, pickets, pole + rng.normal(0, 0.01, pole.shape)]).astype(np.float32)
    (stem,) = stems(Columns(xyz), xyz[:, 2], 1.25)
    assert stem.middle == pytest.approx([9, 3], abs=0.01) and stem.thickness == pytest.approx(0.04, abs=0.01)


@pytest.mark.parametrize("shape", ["rectangle", "disc", "triangle_down"])
def test_panel_has_the_shape_size_and_normal_of_its_points(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (4000, 2))
    flat = flat[inside(flat, OUTLINES[shape], 0)] * 0.35
    along = np.array([np.cos(0.5), np.sin(0.5)])
    xyz = np.column_stack([flat[:, :1] * along + (2, 1), flat[:, 1] + 2.4]) + rng.normal(0, 0.01, (len(flat), 3))
    (plate,) = detect_panels(xyz, np.ones(len(xyz), bool), np.array([10.0, -3]))
    assert plate.shape == shape
    assert plate.centre == pytest.approx([2, 1, 2.4], abs=0.03)
    assert (plate.width, plate.height) == pytest.approx((0.7, 0.7), abs=0.05)
    assert plate.normal[:2] == pytest.approx([along[1], -along[0]], abs=0.03)
