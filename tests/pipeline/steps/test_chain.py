"""Geometry steps on synthetic clouds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.decimation import simplify
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON, Problem, octree
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from tests.fakes.steps import step_params

FRAME = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))


def go(step: Step, out: Path, inputs: dict[str, Path], **params: Any) -> Done:
    out.mkdir(parents=True, exist_ok=True)
    return step.run(inputs, step_params(step.params, **params), out, silent)


def bumpy(n: int = 120_000, size: float = 12.0, seed: int = 0) -> PointCloud:
    """A gently undulating ground of `size` metres square, scanned with 5 mm of noise."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-size / 2, size / 2, (n, 2))
    z = 0.3 * np.sin(xy[:, 0]) * np.cos(xy[:, 1]) + random.normal(0, 0.005, n)
    xyz = np.column_stack([xy, z]).astype(np.float32)
    rgb = np.full((n, 3), (90, 100, 110), np.uint8)
    return PointCloud(FRAME, xyz, rgb, classification=np.full(n, CODE["road"], np.uint8))


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Voxels and Poisson mesh of the bumpy ground."""
    out = tmp_path_factory.mktemp("ground")
    bumpy().save(out / "cloud.npz")
    cloud = go(VOXEL, out / "voxel", {"cloud": out / "cloud.npz"}).files["cloud"]
    mesh = go(POISSON, out / "poisson", {"cloud": cloud}).files["mesh"]
    return {"cloud": cloud, "mesh": mesh}


def edges(mesh: Mesh) -> tuple[int, int]:
    """Number of border edges, and of edges with more than two faces."""
    pairs = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(pairs, axis=0, return_counts=True)
    return int((counts == 1).sum()), int((counts > 2).sum())


def test_ingest_keeps_millimetres_at_utm_coordinates(tmp_path: Path) -> None:
    cloud = bumpy(5000)
    las.write(tmp_path / "a.laz", cloud.take(slice(0, 3000)))
    las.write(tmp_path / "b.laz", cloud.take(slice(3000, None)))
    inputs = {"cloud.0": tmp_path / "a.laz", "cloud.1": tmp_path / "b.laz"}
    done = go(INGEST, tmp_path / "out", inputs, crs=FRAME.crs, origin=FRAME.origin)
    read = PointCloud.load(done.files["cloud"])
    assert np.abs(read.xyz - cloud.xyz).max() < 0.002
    assert read.rgb is not None and cloud.rgb is not None and (read.rgb == cloud.rgb).all()


def test_ingest_rejects_too_few_points(tmp_path: Path) -> None:
    las.write(tmp_path / "few.laz", bumpy(50))
    with pytest.raises(DataError, match=r"few\.laz: only 50 points"):
        go(INGEST, tmp_path / "out", {"cloud.0": tmp_path / "few.laz"}, crs=FRAME.crs, origin=FRAME.origin)


def test_split_groups_signs_with_buildings_and_omits_vehicles(tmp_path: Path) -> None:
    cloud = bumpy(700)
    names = ("road", "terrain", "building", "road_sign", "high_vegetation", "vehicle", "unclassified")
    classification = np.repeat([CODE[n] for n in names], 100).astype(np.uint8)
    replace(cloud, classification=classification).save(tmp_path / "cloud.npz")
    done = go(SPLIT, tmp_path / "out", {"cloud": tmp_path / "cloud.npz"})
    assert done.metrics["points"] == {"terrain": 200, "building": 200, "vegetation": 100, "rest": 200}


def test_split_warns_of_empty_classes_and_rejects_a_cloud_without_any(tmp_path: Path) -> None:
    bumpy(300).save(tmp_path / "cloud.npz")
    done = go(SPLIT, tmp_path / "out", {"cloud": tmp_path / "cloud.npz"})
    assert any("building" in w for w in done.warnings)
    replace(bumpy(300), classification=np.full(300, CODE["vehicle"], np.uint8)).save(tmp_path / "cars.npz")
    with pytest.raises(DataError, match="no point belongs to"):
        go(SPLIT, tmp_path / "out2", {"cloud": tmp_path / "cars.npz"})


@pytest.mark.parametrize(("vehicles", "warned"), [(60, False), (120, True)])
def test_split_warns_if_much_of_the_cloud_gets_no_surface(tmp_path: Path, vehicles: int, warned: bool) -> None:
    codes = np.repeat([CODE["terrain"], CODE["building"], CODE["high_vegetation"]], 100)
    codes = np.concatenate([codes[vehicles:], np.full(vehicles, CODE["vehicle"])]).astype(np.uint8)
    replace(bumpy(300), classification=codes).save(tmp_path / "cloud.npz")
    done = go(SPLIT, tmp_path / "out", {"cloud": tmp_path / "cloud.npz"})
    assert any("40% of the points" in w and "vehicle" in w for w in done.warnings) == warned


def test_voxel_equals_a_reference_implementation() -> None:
    cloud = bumpy(3000)
    thin = sample(cloud, 0.5)
    cells: dict[tuple[int, ...], list[int]] = {}
    for i, key in enumerate(np.floor(cloud.xyz / 0.5 + (0, 0, 0.5)).astype(int).tolist()):
        cells.setdefault(tuple(key[::-1]), []).append(i)
    expected = np.array([cloud.xyz[members].mean(axis=0) for _, members in sorted(cells.items())])
    assert len(thin) == len(cells)
    assert np.abs(thin.xyz - expected).max() < 1e-3


def test_normals_point_to_the_scanner_also_under_a_bridge(tmp_path: Path) -> None:
    floor = bumpy(20_000)
    ceiling = replace(floor, xyz=floor.xyz + np.array([0, 0, 4], np.float32))
    PointCloud.join([floor, ceiling]).save(tmp_path / "cloud.npz")
    Trajectory(np.array([np.nan]), np.array([[0.0, 0.0, 2.0]])).save(tmp_path / "path.npz")
    done = go(VOXEL, tmp_path / "out", {"cloud": tmp_path / "cloud.npz", "path": tmp_path / "path.npz"})
    thin = PointCloud.load(done.files["cloud"])
    assert thin.normal is not None
    below = thin.xyz[:, 2] < 2
    assert (thin.normal[below, 2] > 0).mean() > 0.999 and (thin.normal[~below, 2] < 0).mean() > 0.999


def test_normals_of_an_airborne_cloud_point_up_and_out(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    wall = random.uniform(0, 1, (20_000, 3)) * (4, 0, 3)  # a wall to the south of its roof
    roof = random.uniform(0, 1, (20_000, 3)) * (4, 4, 0) + (0, 0, 3)
    xyz = np.concatenate([wall, roof]).astype(np.float32)
    PointCloud(FRAME, xyz, classification=np.full(len(xyz), 6, np.uint8)).save(tmp_path / "cloud.npz")
    thin = PointCloud.load(go(VOXEL, tmp_path / "out", {"cloud": tmp_path / "cloud.npz"}).files["cloud"])
    assert thin.normal is not None
    on_roof = thin.xyz[:, 1] > 0.3
    on_wall = (thin.xyz[:, 2] > 0.5) & (thin.xyz[:, 2] < 2.5)
    assert (thin.normal[on_roof, 2] > 0.9).mean() > 0.99
    assert (thin.normal[on_wall, 1] < -0.9).mean() > 0.95


@pytest.mark.parametrize("length", [30.0, 100.0, 330.0, 1000.0])
def test_octree_cell_size_is_independent_of_the_extent(length: float) -> None:
    depth, scale = octree(length, 0.05)
    assert scale >= 1.02
    assert scale * length / 2**depth == pytest.approx(0.05)
    assert octree(100.0, 0.05)[0] == 11


def test_poisson_follows_the_ground(ground: dict[str, Path]) -> None:
    mesh, cloud = Mesh.load(ground["mesh"]), PointCloud.load(ground["cloud"])
    assert distances(cloud.xyz, mesh).mean() < 0.01


def test_poisson_is_deterministic(ground: dict[str, Path], tmp_path: Path) -> None:
    again = Mesh.load(go(POISSON, tmp_path, {"cloud": ground["cloud"]}).files["mesh"])
    once = Mesh.load(ground["mesh"])
    assert (again.vertices == once.vertices).all() and (again.faces == once.faces).all()


def test_poisson_falls_back_to_a_lower_depth_after_crashes(
    ground: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    real = sandbox.call

    def flaky(target: str, problems: list[Problem], *args: Any, **kwargs: Any) -> Any:
        calls.append(problems[0].depth)
        if len(calls) < 3:
            raise StepError("poisson", "crashed (exit status -11)", "")
        return real(target, problems, *args, **kwargs)

    monkeypatch.setattr(sandbox, "call", flaky)
    done = go(POISSON, tmp_path, {"cloud": ground["cloud"]}, depth=8)
    assert calls == [calls[0], calls[0], calls[0] - 1]
    assert done.metrics["depth"] == 7 and len(done.warnings) == 2


def test_trim_removes_faces_without_supporting_points(ground: dict[str, Path], tmp_path: Path) -> None:
    done = go(TRIM, tmp_path, ground, max_edge=0.25)
    mesh, cloud = Mesh.load(done.files["mesh"]), PointCloud.load(ground["cloud"])
    side = np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2)
    assert side.max() <= 0.25 * done.metrics["widened"] + 1e-6
    low, high = cloud.xyz.min(axis=0) - 0.3, cloud.xyz.max(axis=0) + 0.3
    assert ((mesh.vertices >= low) & (mesh.vertices <= high)).all()
    assert 12**2 <= mesh.face_area.sum() <= 12.5**2 * 1.03  # undulation increases the area by 2 to 3 %


def test_small_islands_are_removed(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    vertices = np.concatenate([square, square * 0.5 + 5, square * 3 + 10])
    Mesh(FRAME, vertices, np.concatenate([faces, faces + 4, faces + 8])).save(tmp_path / "mesh.npz")
    done = go(ISLANDS, tmp_path / "out", {"mesh": tmp_path / "mesh.npz"}, min_area=0.5)
    assert Mesh.load(done.files["mesh"]).face_area.sum() == pytest.approx(10.0)
    assert done.metrics["islands_removed"] == 1


def test_decimate_keeps_the_border_and_flips_no_face(ground: dict[str, Path], tmp_path: Path) -> None:
    trimmed = go(TRIM, tmp_path / "trim", ground, max_edge=0.5)
    full = Mesh.load(trimmed.files["mesh"])
    done = go(DECIMATE, tmp_path / "out", {"mesh": trimmed.files["mesh"]}, target=10_000)
    small = Mesh.load(done.files["mesh"])
    assert len(small) <= 10_000 and done.metrics["border_kept"]
    assert edges(small)[0] == edges(full)[0], "border edges are kept, and no new ones created"
    assert edges(small)[1] == 0
    assert (small.face_normal[small.face_area > 1e-6, 2] > -0.01).all()
    assert distances(full.vertices, small).mean() < 0.01


def test_faces_with_only_border_edges_are_not_decimated() -> None:
    random = np.random.default_rng(0)
    corners = random.uniform(0, 50, (30_000, 1, 3)) + random.uniform(-0.1, 0.1, (30_000, 3, 3))
    mesh = Mesh(FRAME, corners.reshape(-1, 3).astype(np.float32), np.arange(90_000, dtype=np.int32).reshape(-1, 3))
    assert len(simplify(mesh, 10_000)) == 30_000  # all edges are borders


def test_plants_are_detected_at_their_positions(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    trees = [(2.0, 3.0, 6.0, 1.5), (9.0, 3.0, 8.0, 2.0), (5.0, 10.0, 3.0, 1.0)]
    points = []
    for x, y, height, radius in trees:
        ball = random.normal(size=(4000, 3))
        ball *= radius / np.linalg.norm(ball, axis=1, keepdims=True)
        points.append(ball + (x, y, height - radius))
    xyz = np.concatenate(points).astype(np.float32)
    PointCloud(FRAME, xyz).save(tmp_path / "v.npz")
    flat = np.column_stack([random.uniform(0, 12, (5000, 2)), np.zeros(5000)]).astype(np.float32)
    PointCloud(FRAME, flat).save(tmp_path / "t.npz")
    done = go(PLANTS, tmp_path / "out", {"vegetation": tmp_path / "v.npz", "terrain": tmp_path / "t.npz"})
    rows = np.loadtxt(done.files["csv"], delimiter=",", skiprows=1, ndmin=2)
    assert len(rows) == 3
    rows[:, :3] = FRAME.to_local(rows[:, :3])
    for x, y, height, radius in trees:
        found = rows[np.hypot(rows[:, 0] - x, rows[:, 1] - y).argmin()]
        assert np.hypot(found[0] - x, found[1] - y) < 0.6
        assert abs(found[2]) < 0.1 and abs(found[3] - height) < 0.2 and abs(found[4] - radius) < 0.4
