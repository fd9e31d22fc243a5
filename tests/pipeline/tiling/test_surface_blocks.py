"""Poisson in blocks: partition of points, and one surface without cracks, identical on any number of cores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud
from scan2sim.pipeline.steps.poisson import POISSON, Problem
from scan2sim.pipeline.tiling.surface_blocks import Block, Surface, partition, stitch
from tests.fakes.steps import step_params

FRAME = Frame("EPSG:32633", (500000.2, 5400000.2, 200.0))
SIZE, VOXEL = 26.4, 0.1
BLOCK_POINTS = 25_000
CRACK_FREE_M = 12.2
"""Half the width of the part of the ground in which no edge may be open."""


def height(xy: F64) -> F64:
    return np.asarray(0.3 * np.sin(xy[:, 0]) * np.cos(xy[:, 1]))


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undulating ground of 26 m with one point per voxel, 5 mm of noise, and true normals."""
    random = np.random.default_rng(0)
    steps = np.arange(-SIZE / 2, SIZE / 2, VOXEL) + VOXEL / 2
    xy = np.stack(np.meshgrid(steps, steps), axis=2).reshape(-1, 2)
    xy = xy + random.uniform(-VOXEL / 4, VOXEL / 4, xy.shape)
    xyz = np.column_stack([xy, height(xy) + random.normal(0, 0.005, len(xy))]).astype(np.float32)
    slope = 0.3 * np.column_stack([np.cos(xy[:, 0]) * np.cos(xy[:, 1]), -np.sin(xy[:, 0]) * np.sin(xy[:, 1])])
    normal = np.column_stack([-slope, np.ones(len(xy))])
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    path = tmp_path_factory.mktemp("cloud") / "cloud.npz"
    PointCloud(FRAME, xyz, normal=normal).save(path)
    return path


def reconstruct(cloud: Path, out: Path, **settings: Any) -> tuple[Done, Mesh]:
    out.mkdir(parents=True, exist_ok=True)
    done = POISSON.run({"cloud": cloud}, step_params(POISSON.params, cell=1.0, **settings), out, silent)
    return done, Mesh.load(done.files["mesh"])


@pytest.fixture(scope="module")
def in_blocks(cloud: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Mesh]:
    """The ground in four blocks, on two cores."""
    return reconstruct(cloud, tmp_path_factory.mktemp("blocks"), block_points=BLOCK_POINTS, threads=2)


def open_edges(mesh: Mesh) -> F64:
    """Midpoints (E, 3) of edges that don't have two faces."""
    pairs = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(pairs, axis=0, return_counts=True)
    return np.asarray(mesh.vertices[edges[counts != 2]].mean(axis=1), np.float64)


def on_ground(mesh: Mesh) -> F64:
    """Vertices (V, 3) of the ground within the points' extent."""
    inside = (np.abs(mesh.vertices[:, :2]) < CRACK_FREE_M).all(axis=1) & (np.abs(mesh.vertices[:, 2]) < 1)
    return mesh.vertices[inside].astype(np.float64)


@pytest.mark.parametrize("threads", [1, 8])
def test_result_is_byte_identical_on_any_number_of_threads(
    cloud: Path, in_blocks: tuple[Done, Mesh], tmp_path: Path, threads: int
) -> None:
    done, _ = reconstruct(cloud, tmp_path, block_points=BLOCK_POINTS, threads=threads)
    assert done.metrics["blocks"] == 4
    assert done.files["mesh"].read_bytes() == in_blocks[0].files["mesh"].read_bytes()


def test_blocks_meet_without_cracks(in_blocks: tuple[Done, Mesh]) -> None:
    cracks = open_edges(in_blocks[1])
    assert not ((np.abs(cracks[:, :2]) < CRACK_FREE_M).all(axis=1) & (np.abs(cracks[:, 2]) < 1)).any()


def test_surface_in_blocks_is_as_accurate_as_in_one_piece(
    cloud: Path, in_blocks: tuple[Done, Mesh], tmp_path: Path
) -> None:
    done, whole = reconstruct(cloud, tmp_path)
    assert done.metrics["blocks"] == 1
    error = [np.abs(v[:, 2] - height(v)).mean() for v in (on_ground(whole), on_ground(in_blocks[1]))]
    assert error[0] < 0.01
    assert error[1] < 1.02 * error[0]


def test_accuracy_is_not_reduced_at_block_boundaries(cloud: Path, in_blocks: tuple[Done, Mesh]) -> None:
    """Vertices next to boundaries, at multiples of 6.4 m in the world, are as accurate as all others."""
    vertices = on_ground(in_blocks[1])
    error = np.abs(vertices[:, 2] - height(vertices))
    to_wall = np.abs(np.mod(vertices[:, :2] + FRAME.origin[:2] + 3.2, 6.4) - 3.2).min(axis=1)
    assert error[to_wall < VOXEL].mean() < 1.1 * error.mean()


def test_partition_is_on_a_world_grid_and_covers_every_point_once() -> None:
    random = np.random.default_rng(1)
    xy = random.uniform((0, 0), (100, 60), (50_000, 2))
    blocks = partition(xy, 6.4, np.zeros(2), 2.4, 10_000)
    assert len(blocks) > 4
    inside = np.array([block.inside(xy) for block in blocks])
    assert (inside.sum(axis=0) == 1).all() and (inside.sum(axis=1) <= 10_000).all()
    walls = np.array([limit for block in blocks for limit in (*block.low, *block.high) if np.isfinite(limit)])
    assert np.abs(walls / 6.4 - np.rint(walls / 6.4)).max() < 1e-9
    assert partition(xy[:10_000], 6.4, np.zeros(2), 2.4, 10_000) == [Block()]


def test_small_clouds_are_not_divided_at_any_density() -> None:
    xy = np.random.default_rng(2).uniform(0, 20, (50_000, 2))
    assert partition(xy, 6.4, np.zeros(2), 2.4, 1_000) == [Block()]


def test_stitching_closes_different_borders() -> None:
    """The second border has a vertex more than the first, and a step that is too high to be welded."""
    left = np.array([[-1, 0, 0], [-1, 2, 0], [-1, 4, 0], [0, 0, 0], [0, 2, 0], [0, 4, 0]], np.float32)
    right = np.array([[0, 0, 0.001], [0, 1, 0], [0, 2, 0], [0, 4, 0.3], [1, 0, 0], [1, 2, 0], [1, 4, 0]], np.float32)
    blocks = [Block(high=(0.0, np.inf)), Block(low=(0.0, -np.inf))]
    surfaces = [
        Surface(left, np.array([[0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2]], np.int32), np.full(6, 8, np.float32)),
        Surface(
            right,
            np.array([[0, 4, 1], [4, 5, 1], [1, 5, 2], [2, 5, 3], [5, 6, 3]], np.int32),
            np.full(7, 8, np.float32),
        ),
    ]
    one = stitch(surfaces, blocks, 0.05)
    seam = open_edges(Mesh(FRAME, one.vertices, one.faces))
    assert len(one.vertices) == 6 + 7 - 2  # two pairs are welded
    on_wall = seam[np.abs(seam[:, 0]) < 1e-6]
    assert np.abs(on_wall - (0, 4, 0.15)).max() < 1e-6  # only the height of the step, at the end of the wall, is open


def test_crashed_block_is_retried_and_then_coarsened(
    cloud: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int]] = []
    real = sandbox.call

    def flaky(target: str, problems: list[Problem], *args: Any, **kwargs: Any) -> Any:
        calls.append((len(problems), problems[0].depth))
        if len(calls) < 3:
            raise StepError("poisson", "crashed (exit status -11)", "")
        return real(target, problems, *args, **kwargs)

    monkeypatch.setattr(sandbox, "call", flaky)
    done, mesh = reconstruct(cloud, tmp_path, block_points=BLOCK_POINTS, threads=1)
    depth = calls[0][1]
    assert calls == [(4, depth), (1, depth), (1, depth - 1), (1, depth), (1, depth), (1, depth)]
    assert len(done.warnings) == 2 and done.metrics["cell_m"] == pytest.approx(0.2)
    cracks = open_edges(mesh)
    assert not ((np.abs(cracks[:, :2]) < CRACK_FREE_M).all(axis=1) & (np.abs(cracks[:, 2]) < 1)).any()
