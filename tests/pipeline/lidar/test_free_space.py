"""Free space: surfaces that rays pass through are removed, surfaces at which they end are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F32, F64, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.lidar.free_space import passed_faces
from scan2sim.pipeline.steps.free_space import FREE_SPACE
from tests.fakes.steps import step_params

SCANNER = np.array([0.0, 0.0, 1.8])


def wall(x: float, width: float = 4.0) -> Mesh:
    """An upright square at x across the x axis, of triangles of 10 cm, around the scanner's height."""
    n = round(width / 0.1)
    y, z = np.meshgrid(np.linspace(-width / 2, width / 2, n + 1), np.linspace(0, width, n + 1), indexing="ij")
    vertices = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    return Mesh(Frame(), vertices, faces.astype(np.int32))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [m.faces + start for m, start in zip(meshes, starts[:-1], strict=True)]
    return Mesh(Frame(), np.concatenate([m.vertices for m in meshes]), np.concatenate(faces).astype(np.int32))


def returns(x: float, half_width: float, seed: int = 0, n: int = 20_000) -> F64:
    """Returns on the plane at x, evenly within `half_width` of the axis, 1 cm noise."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-half_width, half_width, n), 1.8 + random.uniform(-half_width, half_width, n)
    return np.stack([x + random.normal(0, 0.01, n), y, z], axis=1)


def faces_passed(mesh: Mesh, points: F64, ratio: float = 0.5) -> np.ndarray:
    return passed_faces(mesh, np.tile(SCANNER, (len(points), 1)), points, ratio)


def test_bubble_in_front_of_a_wall_is_removed_and_the_wall_kept() -> None:
    mesh = joined(wall(6, 1.0), wall(10))  # the bubble lies between the scanner and the returns on the wall
    free = faces_passed(mesh, returns(10, 1.8))
    x = mesh.corners.mean(axis=1)[:, 0]
    z = mesh.corners.mean(axis=1)[:, 2]
    assert free[(x < 7) & (z > 0.9)].all(), "all faces of the bubble that rays pass through"
    assert not free[x > 7].any()


def test_ratio_of_passing_rays_decides_on_removal() -> None:
    mesh = joined(wall(6, 2.0), wall(10))
    points = np.concatenate([returns(10, 1.4, n=12_000), returns(6, 0.8, seed=1, n=12_000)])  # 50 % end at 6 m
    near = mesh.corners.mean(axis=1)[:, 0] < 7
    middle = near & (np.abs(mesh.corners.mean(axis=1)[:, 1:] - [0, 1.6]).max(axis=1) < 0.3)
    assert not faces_passed(mesh, points, 0.4)[middle].any()
    assert faces_passed(mesh, points, 0.7)[middle].all()


def test_ground_at_grazing_angles_is_robust_to_small_height_errors() -> None:
    x, y = np.meshgrid(np.arange(5, 40, 0.2), np.arange(-3, 3.2, 0.2), indexing="ij")
    n, m = x.shape
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + m, a + m + 1], 1), np.stack([a, a + m + 1, a + 1], 1)]).astype(np.int32)
    random = np.random.default_rng(0)
    below = np.stack([random.uniform(6, 38, 50_000), random.uniform(-2.5, 2.5, 50_000), np.full(50_000, -0.05)], axis=1)
    assert not faces_passed(Mesh(Frame(), vertices, faces), below).any()  # 5 cm are up to 1 m along the ray


def test_too_few_rays_remove_nothing() -> None:
    mesh = joined(wall(6, 1.0), wall(10))
    assert not faces_passed(mesh, returns(10, 0.1, n=3)).any()
    assert not faces_passed(mesh, np.zeros((0, 3))).any()
    assert faces_passed(mesh.keep(np.zeros(len(mesh), bool)), returns(10, 1)).shape == (0,)


def _inputs(folder: Path, points: F32) -> dict[str, Path]:
    joined(wall(6, 1.0), wall(8, 1.0), wall(10)).save(folder / "mesh.npz")
    PointCloud(Frame(), points, time=np.linspace(0, 1, len(points))).save(folder / "cloud.npz")
    Trajectory(np.array([0.0, 1.0]), np.tile(SCANNER, (2, 1))).save(folder / "path.npz")
    return {name: folder / f"{name}.npz" for name in ("mesh", "cloud", "path")}


def test_step_removes_surfaces_behind_removed_ones(tmp_path: Path) -> None:
    inputs = _inputs(tmp_path, returns(10, 1.8).astype(np.float32))
    (tmp_path / "out").mkdir()
    done = FREE_SPACE.run(inputs, step_params(FREE_SPACE.params), tmp_path / "out", silent)
    left = Mesh.load(done.files["mesh"]).corners.mean(axis=1)
    assert (left[left[:, 2] > 0.9][:, 0] > 9).all()
    assert done.metrics["faces"] == len(left) < done.metrics["faces_in"] and done.metrics["reason"] == ""


def floor(z: float, x: tuple[float, float]) -> Mesh:
    """Level ground at z, 2 m to each side, of triangles of 10 cm."""
    upright = wall(0)
    vertices = np.stack(
        [x[0] + upright.vertices[:, 2] * (x[1] - x[0]) / 4, upright.vertices[:, 1], 0 * upright.vertices[:, 0] + z], 1
    )
    return Mesh(Frame(), vertices.astype(np.float32), upright.faces)


def test_step_leaves_no_holes_in_the_ground(tmp_path: Path) -> None:
    """Returns lie 40 cm below the ground's only surface: it is kept; a second layer above it is removed."""
    random = np.random.default_rng(0)
    points = np.stack([random.uniform(5, 14, 40_000), random.uniform(-1.5, 1.5, 40_000), np.zeros(40_000)], axis=1)
    inputs = _inputs(tmp_path, points.astype(np.float32))
    joined(floor(0.4, (4, 12)), floor(0.9, (4, 6))).save(inputs["mesh"])
    for keep, least in ((True, 0.99), (False, 0.0)):
        out = tmp_path / str(keep)
        out.mkdir()
        done = FREE_SPACE.run(inputs, step_params(FREE_SPACE.params, keep_lowest=keep), out, silent)
        left = Mesh.load(done.files["mesh"])
        y, z = left.corners.mean(axis=1)[:, 1:].T
        lower = (z < 0.5).sum() / 3200
        assert (lower >= least) if keep else (lower < 0.8)
        assert not ((z > 0.8) & (abs(y) < 0.4)).any()


def test_step_without_times_keeps_all_faces_and_reports_the_reason(tmp_path: Path) -> None:
    inputs = _inputs(tmp_path, returns(10, 1.8).astype(np.float32))
    replace(PointCloud.load(inputs["cloud"]), time=None).save(inputs["cloud"])
    (tmp_path / "out").mkdir()
    done = FREE_SPACE.run(inputs, step_params(FREE_SPACE.params), tmp_path / "out", silent)
    assert done.metrics["faces"] == done.metrics["faces_in"] and "no times" in done.metrics["reason"]
