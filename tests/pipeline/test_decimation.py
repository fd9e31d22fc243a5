"""Decimation: requirements on all backends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline import decimation
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.steps.decimate import DECIMATE, DecimateParams
from tests.fakes.steps import step_params

NAMES = plugins.names(decimation.__name__)
SIDE = 120


def hills() -> Mesh:
    """Wavy ground of 12 x 12 m with a hole, 28 K triangles with upward normals."""
    random = np.random.default_rng(0)
    i, j = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    x, y = (0.1 * axis + random.uniform(-0.02, 0.02, axis.shape) for axis in (i, j))
    z = 0.5 * np.sin(x) * np.cos(y)
    a = (i[:-1, :-1] * SIDE + j[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([a, a + SIDE, a + SIDE + 1], 1), np.stack([a, a + SIDE + 1, a + 1], 1)])
    mesh = Mesh(Frame(), np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32), faces.astype(np.int32))
    middle = mesh.corners.mean(axis=1)[:, :2] - 6
    return mesh.keep(np.hypot(*middle.T) > 1)


def border(mesh: Mesh) -> set[frozenset[tuple[float, ...]]]:
    """Edges with only one face, by positions of their ends."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    once, count = np.unique(edges, axis=0, return_counts=True)
    return {frozenset(map(tuple, ends)) for ends in mesh.vertices[once[count == 1]].tolist()}


def height_error(small: Mesh) -> float:
    """95th percentile of the distance of vertices from the ground, metres."""
    x, y, z = small.vertices.T
    return float(np.percentile(np.abs(z - 0.5 * np.sin(x) * np.cos(y)), 95))


def simplified(mesh: Mesh, name: str, target: int, *, keep_border: bool) -> Mesh:
    if missing := plugins.missing(decimation.__name__, name):
        pytest.skip(f"needs {missing}")
    return decimation.simplify(mesh, target, keep_border=keep_border, backend=name)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("keep_border", [True, False])
def test_decimated_surface_keeps_its_shape(name: str, keep_border: bool) -> None:
    whole = hills()
    small = simplified(whole, name, 4000, keep_border=keep_border)
    assert 3800 <= len(small) <= 4010
    assert np.isfinite(small.vertices).all() and small.frame == whole.frame
    assert small.faces.max() + 1 == len(small.vertices) == len(np.unique(small.faces))
    assert (small.face_normal[small.face_area > 1e-6, 2] > 0).all(), "faces are flipped"
    assert height_error(small) < 0.005
    assert abs(float(small.face_area.sum() / whole.face_area.sum()) - 1) < 0.01
    if keep_border:
        assert border(small) == border(whole)


@pytest.mark.parametrize("name", NAMES)
def test_small_mesh_is_unchanged(name: str) -> None:
    whole = hills()
    same = simplified(whole, name, len(whole), keep_border=False)
    assert np.array_equal(same.vertices, whole.vertices) and np.array_equal(same.faces, whole.faces)


@pytest.mark.parametrize("name", NAMES)
def test_step_uses_the_selected_backend(tmp_path: Path, name: str) -> None:
    if missing := plugins.missing(decimation.__name__, name):
        pytest.skip(f"needs {missing}")
    hills().save(tmp_path / "mesh.npz")
    (tmp_path / "out").mkdir()
    params = step_params(DecimateParams, target=10_000, backend=name)
    done = DECIMATE.run({"mesh": tmp_path / "mesh.npz"}, params, tmp_path / "out", silent)
    small = Mesh.load(done.files["mesh"])
    same = simplified(hills(), name, 10_000, keep_border=done.metrics["border_kept"])
    assert np.array_equal(small.vertices, same.vertices) and np.array_equal(small.faces, same.faces)
    assert done.metrics["border_kept"] and not done.warnings


def test_unknown_backend_lists_available_ones() -> None:
    assert DECIMATE.check is not None
    with pytest.raises(SettingError, match=r"decimate\.backend: unknown value 'pyfqmr'.*fast_simplification, py"):
        DECIMATE.check(DecimateParams(backend="pyfqmr"))


def test_surface_of_a_sparse_map_gets_six_triangles_per_point(tmp_path: Path) -> None:
    whole, rng = hills(), np.random.default_rng(0)
    whole.save(tmp_path / "mesh.npz")
    xy = rng.uniform(0.5, 11, (2000, 2))
    xyz = np.column_stack([xy, 0.5 * np.sin(xy[:, 0]) * np.cos(xy[:, 1])]).astype(np.float32)
    PointCloud(Frame(), xyz).save(tmp_path / "cloud.npz")
    inputs = {"mesh": tmp_path / "mesh.npz", "cloud": tmp_path / "cloud.npz"}
    sizes = {}
    for by_points in (True, False):
        (out := tmp_path / str(by_points)).mkdir()
        done = DECIMATE.run(inputs, step_params(DecimateParams, by_points=by_points), out, silent)
        sizes[by_points] = len(small := Mesh.load(done.files["mesh"]))
        assert height_error(small) < 0.02
    assert sizes[False] == len(whole) and sizes[True] == pytest.approx(12_000, rel=0.05)
