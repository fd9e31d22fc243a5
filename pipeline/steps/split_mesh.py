"""Split mesh: the surfaces of a tile that was made from a textured mesh, by class of the points nearby.

The whole mesh is simplified to what all classes may have together before it is split, so that the classes share the
vertices along their borders; `decimate` then keeps these borders, and no gap opens between them.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, I64, Frame, Mesh, PointCloud

OWN_POINTS = 8
"""A face with as many points takes its class from them, a smaller one from the points nearest to it."""
NEIGHBOURS = 16
SMOOTHING_ROUNDS = 12
SMOOTHING_WEIGHT = 2.0
"""Weight of the neighbouring faces relative to the points of a face."""
CREASE_WEIGHT = 0.05
"""Weight of a neighbour across a right angle, where classes meet, relative to one in the same plane."""
MERGE_ROUNDS = 6


class SplitContext(Context):
    """Frame of the tile, and settings of other steps by class.

    Attributes:
        origin: (3,) origin of the tile's local coordinates.
        target: number of triangles (`decimate.target`).
        min_area: area of the smallest piece in m2 (`islands.min_area`): smaller ones join the surface around them.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target: dict[str, int] = Field(default_factory=dict)
    min_area: dict[str, float] = Field(default_factory=dict)


class SplitMeshParams(Params):
    """Settings of the split; there is nothing to choose."""

    context: SplitContext = SplitContext()


class _Neighbours(NamedTuple):
    """Pairs of faces that share an edge: indices (E,) of both, length of the edge (m), cosine of their normals."""

    first: I64
    second: I64
    length: F64
    cosine: F64


def split_mesh(inputs: Inputs, params: SplitMeshParams, out: Path, report: Report) -> Done:
    """Split `source_mesh` into a mesh of each class by the classified points of each class, the other inputs.

    Surfaces of points without a mesh of their own (`rest`: vehicles, people, unclassified) belong to `building`.
    Files: a mesh of each class.
    """
    from scan2sim.pipeline.decimation import simplify
    from scan2sim.pipeline.io.source_mesh import SourceMesh

    context = params.context
    source = SourceMesh.load(inputs["source_mesh"]).mesh
    mesh = Mesh(source.frame, source.vertices, source.faces).moved_to(Frame(source.frame.crs, context.origin))
    report(0.1, "simplifying")
    faces_in, budget = len(mesh), sum(context.target.values())
    small = simplify(mesh, budget)
    if len(small) > budget * 1.05:  # open borders of the mesh itself
        small = simplify(small, budget, keep_border=False)
    mesh = small
    report(0.5, "classes")
    groups = [name for name in inputs if name not in ("source_mesh", "rest")]
    label = classes_of_faces(mesh, inputs, groups, [context.min_area.get(group, 0.0) for group in groups])
    files, counts = {}, {}
    for i, group in enumerate(groups):
        part = mesh.keep(label == i)
        part.save(out / f"{group}.npz")
        files[group], counts[group] = out / f"{group}.npz", len(part)
    return Done(files, {"faces_in": faces_in, "simplified": len(mesh), "faces": counts})


def classes_of_faces(mesh: Mesh, inputs: Inputs, groups: list[str], min_area: list[float]) -> I64:
    """(F,) index into `groups` of every face: that of its points, smoothed along the surface, without small pieces."""
    from scipy.sparse import coo_matrix

    clouds = [PointCloud.load(inputs[name]).xyz for name in (*groups, "rest")]
    index = np.array([*range(len(groups)), groups.index("building")])
    votes = _votes(mesh, np.concatenate(clouds), np.repeat(index, [len(cloud) for cloud in clouds]), len(groups))
    near = neighbours(mesh)
    weight = near.length * np.where(near.cosine > 0, near.cosine, 0) ** 8
    weight = CREASE_WEIGHT * near.length + (1 - CREASE_WEIGHT) * weight
    n = len(mesh)
    rows = np.concatenate([near.first, near.second])
    columns = np.concatenate([near.second, near.first])
    matrix = coo_matrix((np.tile(weight, 2), (rows, columns)), shape=(n, n)).tocsr()
    total = np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1e-12)
    belief = votes
    for _ in range(SMOOTHING_ROUNDS):
        belief = votes + SMOOTHING_WEIGHT * (matrix @ belief) / total[:, None]
        belief /= belief.sum(axis=1, keepdims=True)
    return _merged(mesh, belief.argmax(axis=1), near, np.array(min_area))


def _votes(mesh: Mesh, xyz: F32, group: I64, count: int) -> F64:
    """(F, count) share of each group among the points on each face, or nearest to it.

    Args:
        mesh: the faces.
        xyz, group: (N, 3) points and (N,) their groups.
        count: number of groups.
    """
    import open3d as o3d
    from scipy.spatial import cKDTree

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    face = scene.compute_closest_points(np.ascontiguousarray(xyz, np.float32))["primitive_ids"].numpy().astype(np.int64)
    votes = np.bincount(face * count + group, minlength=len(mesh) * count).reshape(len(mesh), count).astype(np.float64)
    few = np.flatnonzero(votes.sum(axis=1) < OWN_POINTS)
    if len(few):
        k = min(NEIGHBOURS, len(xyz))
        index = cKDTree(xyz).query(mesh.corners[few].mean(axis=1), k, workers=-1)[1].reshape(len(few), k)
        for i in range(count):
            votes[few, i] = (group[index] == i).sum(axis=1)
    return np.asarray(votes / np.maximum(votes.sum(axis=1, keepdims=True), 1e-12))


def neighbours(mesh: Mesh) -> _Neighbours:
    """Pairs of faces that share an edge; of an edge with more than two faces, consecutive ones."""
    ends = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    key = ends[:, 0] * len(mesh.vertices) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    first, second = order[same] // 3, order[same + 1] // 3
    length = np.linalg.norm(mesh.vertices[ends[order[same], 0]] - mesh.vertices[ends[order[same], 1]], axis=1)
    normal = mesh.face_normal
    cosine = np.einsum("ij,ij->i", normal[first], normal[second])
    return _Neighbours(first, second, length.astype(np.float64), cosine.astype(np.float64))


def _merged(mesh: Mesh, label: I64, near: _Neighbours, min_area: F64) -> I64:
    """The labels (F,), pieces smaller than the minimum of their class joined to the class with the longest border."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n, area = len(mesh), mesh.face_area.astype(np.float64)
    for share in np.linspace(0, 1, MERGE_ROUNDS + 1)[1:] ** 2:  # the smallest pieces first
        same = label[near.first] == label[near.second]
        pairs = coo_matrix((np.ones(int(same.sum()), bool), (near.first[same], near.second[same])), shape=(n, n))
        pieces, piece = connected_components(pairs, directed=False)
        size = np.bincount(piece, area, pieces)
        border = np.zeros((pieces, len(min_area)))
        for one, other in ((near.first, near.second), (near.second, near.first)):
            np.add.at(border, (piece[one[~same]], label[other[~same]]), near.length[~same])
        label_of_piece = np.zeros(pieces, np.int64)
        label_of_piece[piece] = label
        small = (size < share * min_area[label_of_piece]) & (border.max(axis=1) > 0)
        label_of_piece[small] = border[small].argmax(axis=1)
        label = label_of_piece[piece]
    return label


SPLIT_MESH = Step("split_mesh", 1, split_mesh, SplitMeshParams, memory=(0.5, 8))
"""Reads the largest file of the tile: see docs/reference/formats.md for the memory it needs."""
