"""Seams of 3D Tiles: maximum width of cracks between neighbouring tiles at any combination of levels of detail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import F64, Frame, Mesh
from scan2sim.pipeline.geometry.boundary_curve import curve
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "tiles3d"
VERTEX_TOLERANCE_M = 2e-3
"""Distance within which vertices of two tiles are the same."""
MAX_CRACK_M = 1e-3
"""Maximum width of a crack."""
SAMPLES_PER_EDGE = 5
"""Number of samples on each edge of a border."""


@dataclass(frozen=True)
class TileContent:
    """Content of a tile of the tileset.

    Attributes:
        tiles: names of the finest tiles that it covers.
        finer: whether there are finer levels.
        mesh: its mesh, metres in the frame of a tile.
    """

    tiles: frozenset[str]
    finer: bool
    mesh: Mesh


def missing() -> str:
    """It has no requirements."""
    return ""


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Measure all possible cracks, see the module's docstring."""
    root = json.loads((export / "tileset.json").read_text(encoding="utf-8"))["root"]
    start = np.eye(4) if "content" in root else np.asarray(np.linalg.inv(_node_transform(root["children"][0])))
    contents = list(_tile_contents(export, root, start))
    fine = [one for one in contents if not one.finer]
    ends = [_ends(one.mesh) for one in fine]
    borders, worst = 0.0, 0.0
    for (own, own_ends), (other, other_ends) in permutations(zip(fine, ends, strict=True), 2):
        edges = _shared(own_ends, other_ends)
        if len(edges):
            borders += float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum()) / 2
            between = np.linspace(edges[:, 0], edges[:, 1], SAMPLES_PER_EDGE).reshape(-1, 3)
            worst = max([worst, *(_away(one.mesh, between) for one in contents if _beside(one, own, other))])
    metrics = {
        "tiles": len(contents),
        "finest": len(fine),
        "borders_m": round(borders, 1),
        "crack_max_m": round(2 * worst, 6),
    }
    if 2 * worst > MAX_CRACK_M:
        raise Fault(f"cracks between levels: {metrics}")
    return metrics


def _tile_contents(export: Path, node: dict[str, Any], above: F64) -> Iterator[TileContent]:
    """All tiles at and below a node; `above` transforms the node's frame to that of the measurements."""
    below = []
    for child in node.get("children", ()):
        below += list(_tile_contents(export, child, above @ _node_transform(child)))
    yield from below
    if "content" in node:
        names = frozenset().union(*(one.tiles for one in below)) or frozenset({node["content"]["uri"]})
        yield TileContent(names, bool(below), _mesh(export / node["content"]["uri"], above))


def _node_transform(node: dict[str, Any]) -> F64:
    return np.asarray(np.reshape(node["transform"], (4, 4)).T, np.float64)


def _mesh(path: Path, transform: F64) -> Mesh:
    """All meshes of a GLB as one with merged vertices, z up and transformed."""
    import trimesh

    read = trimesh.load_scene(path, process=False)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in read.geometry.values()])
    vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    upright = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    transformed = upright @ transform[:3, :3].T + transform[:3, 3]
    return Mesh(Frame(), transformed.astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def _ends(mesh: Mesh) -> F64:
    """(E, 2, 3) boundary edges, of one face only."""
    edges = curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges
    return mesh.vertices[edges].astype(np.float64)


def _shared(own: F64, other: F64) -> F64:
    """Edges of a tile whose ends are also vertices of another one."""
    from scipy.spatial import cKDTree

    if not len(own) or not len(other):
        return own[:0]
    distance, _ = cKDTree(other.reshape(-1, 3)).query(own, distance_upper_bound=VERTEX_TOLERANCE_M)
    return np.asarray(own[np.isfinite(distance).all(axis=1)])


def _beside(one: TileContent, own: TileContent, other: TileContent) -> bool:
    """Whether a content can be contents on `own`'s side of the border to `other`."""
    return own.tiles <= one.tiles and not other.tiles <= one.tiles


def _away(mesh: Mesh, points: F64) -> float:
    """Largest distance in metres from points to a mesh."""
    nearest, _ = Renderer([Body(mesh)]).closest_points(points.astype(np.float32))
    return float(np.linalg.norm(nearest - points, axis=1).max())
