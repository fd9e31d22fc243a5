"""Split of a textured mesh by class: common borders stay closed, small pieces join their surroundings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import I32, Frame, Mesh, PointCloud
from scan2sim.pipeline.io.source_mesh import SourceMesh
from scan2sim.pipeline.steps.decimate import DecimateContext, DecimateParams, decimate
from scan2sim.pipeline.steps.split_mesh import SplitContext, SplitMeshParams, split_mesh

GROUPS = ("terrain", "building", "vegetation")
N = 160
CELL_M = 0.1


def ground() -> Mesh:
    """Uneven square of 16 x 16 m with a wall at its far end, 51,200 triangles."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(N + 1), np.arange(N + 1), indexing="ij")
    z = np.where(y > 120, 0.0, 0.0) + rng.normal(0, 0.05, x.shape)
    vertices = np.column_stack([x.ravel() * CELL_M, y.ravel() * CELL_M, z.ravel()]).astype(np.float32)
    corner = (np.arange(N)[:, None] * (N + 1) + np.arange(N)).ravel()
    a, b, c, d = corner, corner + N + 1, corner + N + 2, corner + 1
    faces: I32 = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]).astype(np.int32)
    return Mesh(Frame(), vertices, faces)


def split(tmp_path: Path, mesh: Mesh, target: int) -> dict[str, Mesh]:
    """Split by points: building where y > 12 m, a speck of vegetation on the ground, the rest terrain."""
    count = len(mesh)
    source = SourceMesh(
        Mesh(mesh.frame, mesh.vertices, mesh.faces, uv=np.zeros((count, 3, 2), np.float32),
             page=np.full(count, -1, np.int16)),
        np.full((count, 3, 3), 200, np.uint8),
    )  # fmt: skip
    source.save(tmp_path / "source.npz")
    points = mesh.corners.mean(axis=1)
    speck = np.linalg.norm(points[:, :2] - (4, 4), axis=1) < 0.3
    built = points[:, 1] + 0.3 * np.sin(points[:, 0] * 9) > 12
    kinds = {"terrain": ~speck & ~built, "building": built, "vegetation": speck, "rest": np.zeros(count, bool)}
    inputs = {"source_mesh": tmp_path / "source.npz"}
    for name, chosen in kinds.items():
        PointCloud(Frame(), points[chosen]).save(tmp_path / f"in_{name}.npz")
        inputs[name] = tmp_path / f"in_{name}.npz"
    context = SplitContext(target=dict.fromkeys(GROUPS, target), min_area=dict.fromkeys(GROUPS, 1.0))
    done = split_mesh(inputs, SplitMeshParams(context=context), tmp_path, silent)
    return {name: Mesh.load(done.files[name]) for name in GROUPS}


def open_edges(mesh: Mesh) -> set[tuple[bytes, ...]]:
    """Edges with one face, by the positions of their ends."""
    ends = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(ends, axis=0, return_counts=True)
    return {tuple(sorted(mesh.vertices[i].tobytes() for i in edge)) for edge in edges[count == 1]}


def test_classes_share_their_border_after_decimation(tmp_path: Path) -> None:
    parts = split(tmp_path, ground(), 10_000)
    assert not len(parts["vegetation"])  # smaller than min_area: joined to the terrain
    final = []
    for name in ("terrain", "building"):
        parts[name].save(tmp_path / f"{name}.npz")
        params = DecimateParams(target=10_000, context=DecimateContext(keep_border=True))
        folder = tmp_path / name
        folder.mkdir()
        final.append(Mesh.load(decimate({"mesh": tmp_path / f"{name}.npz"}, params, folder, silent).files["mesh"]))
        assert len(final[-1]) <= 10_500
    common = open_edges(final[0]) & open_edges(final[1])
    length = sum(np.linalg.norm(np.subtract(*(np.frombuffer(end, np.float32) for end in edge))) for edge in common)
    assert length > 0.9 * N * CELL_M  # the whole border, along x
    inside = [
        edge for mesh in final for edge in open_edges(mesh) - common
        if all(0.05 < v < N * CELL_M - 0.05 for end in edge for v in np.frombuffer(end, np.float32)[:2])
    ]  # fmt: skip
    assert not inside  # no gaps
    assert 12 / 16 - 0.03 < final[0].face_area.sum() / sum(m.face_area.sum() for m in final) < 12 / 16 + 0.03
