"""Seams of 3D Tiles: how wide a crack opens at most where two tiles stand side by side, whatever levels they are at."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from bench.consumers import Fault
from bench.gate.places import Places
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import F64, Frame, Mesh
from scan2sim.pipeline.tiling.borders.boundary_curve import curve

FORMAT = "tiles3d"
SAME = 2e-3
"""Metres within which two tiles' vertices are one."""
WITHIN = 1e-3
"""Metres that a crack may be wide."""
ALONG = 5
"""Places on each edge of a border."""


@dataclass(frozen=True)
class Shown:
    """A tile of the tileset.

    Attributes:
        tiles: names of the finest tiles that it stands for.
        finer: whether there are any.
        mesh: all that it shows, metres around a tile's origin.
    """

    tiles: frozenset[str]
    finer: bool
    mesh: Mesh


def missing() -> str:
    """It needs nothing."""
    return ""


def check(export: Path, places: Places) -> dict[str, Any]:
    """Measure all cracks that can open; see the module."""
    root = json.loads((export / "tileset.json").read_text(encoding="utf-8"))["root"]
    start = np.eye(4) if "content" in root else np.asarray(np.linalg.inv(_place(root["children"][0])))
    shown = list(_shown(export, root, start))
    fine = [one for one in shown if not one.finer]
    ends = [_ends(one.mesh) for one in fine]
    borders, worst = 0.0, 0.0
    for (own, own_ends), (other, other_ends) in permutations(zip(fine, ends, strict=True), 2):
        edges = _shared(own_ends, other_ends)
        if len(edges):
            borders += float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum()) / 2
            between = np.linspace(edges[:, 0], edges[:, 1], ALONG).reshape(-1, 3)
            worst = max([worst, *(_away(one.mesh, between) for one in shown if _beside(one, own, other))])
    figures = {
        "tiles": len(shown),
        "finest": len(fine),
        "borders_m": round(borders, 1),
        "crack_max_m": round(2 * worst, 6),
    }
    if 2 * worst > WITHIN:
        raise Fault(f"cracks open where levels meet: {figures}")
    return figures


def _shown(export: Path, node: dict[str, Any], above: F64) -> Iterator[Shown]:
    """All tiles at and below a node, whose metres `above` turns into those that are measured in."""
    below = []
    for child in node.get("children", ()):
        below += list(_shown(export, child, above @ _place(child)))
    yield from below
    if "content" in node:
        names = frozenset().union(*(one.tiles for one in below)) or frozenset({node["content"]["uri"]})
        yield Shown(names, bool(below), _mesh(export / node["content"]["uri"], above))


def _place(node: dict[str, Any]) -> F64:
    return np.asarray(np.reshape(node["transform"], (4, 4)).T, np.float64)


def _mesh(path: Path, place: F64) -> Mesh:
    """All meshes of a GLB as one, a vertex a place, z up and placed."""
    import trimesh

    read = trimesh.load_scene(path, process=False)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in read.geometry.values()])
    vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    upright = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    there = upright @ place[:3, :3].T + place[:3, 3]
    return Mesh(Frame(), there.astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def _ends(mesh: Mesh) -> F64:
    """(E, 2, 3) edges of one face alone."""
    edges = curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges
    return mesh.vertices[edges].astype(np.float64)


def _shared(own: F64, other: F64) -> F64:
    """Those edges of a tile whose ends another one has, too."""
    from scipy.spatial import cKDTree

    if not len(own) or not len(other):
        return own[:0]
    distance, _ = cKDTree(other.reshape(-1, 3)).query(own, distance_upper_bound=SAME)
    return np.asarray(own[np.isfinite(distance).all(axis=1)])


def _beside(one: Shown, own: Shown, other: Shown) -> bool:
    """Whether a tile can be what is shown on one side of a border."""
    return own.tiles <= one.tiles and not other.tiles <= one.tiles


def _away(mesh: Mesh, places: F64) -> float:
    """Metres from places to a mesh, at most."""
    nearest, _ = Renderer([Body(mesh)]).nearest_places(places.astype(np.float32))
    return float(np.linalg.norm(nearest - places, axis=1).max())
