"""Samples of sheets: the same wherever a plane stands in the voxel grid, and equal in neighbouring tiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import F32, Frame, Mesh, PointCloud
from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid
from scan2sim.pipeline.geometry.normals import oriented_normals
from scan2sim.pipeline.geometry.voxel_grid import sample, sheet_groups, voxel_groups
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from tests.fakes.steps import step_params

VOXEL_M = 0.1
OFFSETS = 5.0 + VOXEL_M / 20 * np.arange(20)
SIZE = (4.0, 3.0)
COLUMNS = round(SIZE[0] / VOXEL_M) * round(SIZE[1] / VOXEL_M)


def plane(axis: int, offset: float, noise: float = 0.004, density: float = 900) -> F32:
    """Points (N, 3) of a plane perpendicular to an axis."""
    random = np.random.default_rng(0)
    n = int(density * SIZE[0] * SIZE[1])
    low = np.where(np.arange(3) == 2, -VOXEL_M / 2, 0)  # on faces of voxels
    xyz = low + random.uniform(0, 1, (n, 3)) * np.insert(SIZE, axis, 0)
    xyz[:, axis] = offset + random.normal(0, noise, n)
    return xyz.astype(np.float32)


def thinned(xyz: F32, frame: Frame | None = None) -> PointCloud:
    cloud = PointCloud(frame or Frame(), xyz)
    return sample(cloud, VOXEL_M, sheet_groups(xyz, VOXEL_M))


@pytest.mark.parametrize("noise", [0.001, 0.004, 0.006])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_plane_gets_one_layer_of_samples_at_any_offset(axis: int, noise: float) -> None:
    for offset in OFFSETS:
        thin = thinned(plane(axis, offset, noise)).xyz
        assert COLUMNS * 0.995 < len(thin) < COLUMNS * 1.015, offset
        assert (thin[:, axis] - offset).std() < 1.4 * noise / np.sqrt(900 * VOXEL_M**2), offset


@pytest.mark.parametrize("axis", [0, 1])
def test_free_standing_wall_has_one_outside_at_any_offset(axis: int) -> None:
    for offset in OFFSETS:
        normal = oriented_normals(thinned(plane(axis, offset)), 16, None).normal
        assert normal is not None and (normal[:, axis] > 0.9).mean() > 0.99, offset


@pytest.mark.parametrize("degrees", [2, 10, 20, 30, 45, 60])
def test_oblique_planes_are_sampled_as_densely_as_others(degrees: float) -> None:
    turn = np.radians(degrees)
    flat = plane(1, 5.0)
    xyz = flat.copy()
    xyz[:, 0] = np.cos(turn) * flat[:, 0] - np.sin(turn) * flat[:, 1]
    xyz[:, 1] = np.sin(turn) * flat[:, 0] + np.cos(turn) * flat[:, 1]
    thin = thinned(xyz).xyz
    across = -np.sin(turn) * thin[:, 0] + np.cos(turn) * thin[:, 1] - 5.0
    assert len(thin) > 0.96 * COLUMNS
    assert np.abs(across).std() < 0.003


def test_parallel_sheets_in_different_voxels_stay_apart() -> None:
    for share in (0.5, 0.1):
        front, back = plane(1, 4.97), plane(1, 5.03)
        xyz = np.concatenate([front, back[: int(share * len(back))]])
        thin = thinned(xyz).xyz
        assert len(thin) > 0.99 * len(voxel_groups(xyz, VOXEL_M)[1])
        assert np.abs(np.abs(thin[:, 1] - 5.0) - 0.03).max() < 0.015


def test_points_in_a_volume_are_grouped_by_voxel() -> None:
    random = np.random.default_rng(0)
    for per_voxel in (4, 30):
        xyz = random.uniform(0, 2, (per_voxel * 8000, 3)).astype(np.float32)
        assert len(thinned(xyz)) > 0.97 * len(voxel_groups(xyz, VOXEL_M)[1])


def test_sparse_points_of_a_plane_are_hardly_joined_along_it() -> None:
    xyz = plane(1, 5.05, density=150)
    assert len(thinned(xyz)) > 0.95 * len(voxel_groups(xyz, VOXEL_M)[1])


def test_groups_partition_the_points() -> None:
    xyz = np.concatenate([plane(axis, 2.0) for axis in range(3)])
    order, starts = sheet_groups(xyz, VOXEL_M)
    assert np.array_equal(np.sort(order), np.arange(len(xyz)))
    assert starts[0] == 0 and (np.diff(starts) > 0).all() and starts[-1] < len(order)
    order, starts = sheet_groups(xyz[:0], VOXEL_M)
    assert len(order) == len(starts) == 0
    assert len(thinned(xyz[:1])) == 1


def test_tiles_get_equal_samples_around_their_border() -> None:
    """Tiles with other origins and other points beyond 1 m of their border."""
    world = np.concatenate([plane(axis, 2.0, noise) for axis in range(3) for noise in (0.004, 0.02)]).astype(np.float64)
    world = snap_to_grid(world + (391_204.0, 5_820_376.0, 33.0))
    x = world[:, 0] - 391_204.0
    samples = []
    for own, origin in ((x < 3.0, (391_190.0, 5_820_381.0, 30.0)), (x > 1.0, (391_207.0, 5_820_377.0, 34.0))):
        frame = Frame("EPSG:32633", origin)
        thin = thinned((world[own] - origin).astype(np.float32), frame)
        place = thin.xyz.astype(np.float64) + origin
        near = np.abs(place[:, 0] - 391_206.0) < 0.5
        samples.append(place[near][np.lexsort(place[near].T)])
    assert len(samples[0]) > 500
    assert np.array_equal(samples[0], samples[1])


def go(step: Step, folder: Path, inputs: dict[str, Path]) -> Done:
    out = folder / step.name
    out.mkdir(parents=True)
    return step.run(inputs, step_params(step.params), out, silent)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_surface_of_a_plane_is_independent_of_its_offset(axis: int, tmp_path: Path) -> None:
    areas, triangles = [], []
    for offset in (5.0, 5.002, 5.025, 5.05):
        folder = tmp_path / f"{offset}"
        folder.mkdir()
        PointCloud(Frame(), plane(axis, offset)).save(folder / "points.npz")
        cloud = go(VOXEL, folder, {"cloud": folder / "points.npz"}).files["cloud"]
        rough = go(POISSON, folder, {"cloud": cloud}).files["mesh"]
        mesh = Mesh.load(go(TRIM, folder, {"mesh": rough, "cloud": cloud}).files["mesh"])
        areas.append(float(mesh.face_area.sum()))
        triangles.append(len(mesh))
        assert np.quantile(np.abs(mesh.vertices[:, axis] - offset), 0.99) < 0.01
    assert max(areas) < 1.03 * min(areas) and max(areas) < 1.25 * SIZE[0] * SIZE[1]
    # marching cubes makes fewer triangles in the face between two cells than elsewhere
    assert max(triangles) < 2 * min(triangles) and max(triangles) < 5 * COLUMNS
