"""A mesh with the plates that photos show: put up, their poles behind them, without what their points made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.furniture.classify import SHEET, sheet
from scan2sim.pipeline.furniture.sign_panels import Plate, inside
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.tiling.borders.open_edges import on_border
from scan2sim.pipeline.tiling.voronoi_cell import Cell

BEFORE, BEHIND, BESIDE = 0.5, 0.05, 0.1
"""Metres before, behind and beside a plate within which surfaces are its own points' smear."""
MOST = 0.3
"""Metres that a pole is moved at most to stand behind its plate."""
_OVER = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6
"""Where a face is looked at (barycentric)."""


def without(mesh: Mesh, plates: Sequence[Plate]) -> Mesh:
    """The mesh without the sheets of plates."""
    gone = np.zeros(len(mesh), bool)
    for piece in pieces(mesh, CODE["road_sign"]):
        corners = mesh.vertices[np.unique(mesh.faces[piece])]
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        gone[piece] = any(np.linalg.norm(middle - plate.centre) < 0.05 for plate in plates)
    return mesh.keep(~gone)


def pieces(mesh: Mesh, code: int) -> list[I64]:
    """Faces of a class in connected pieces."""
    if mesh.classification is None:
        return []
    faces = np.flatnonzero(mesh.classification == code)
    piece = _connected(mesh, faces)
    return [faces[piece == k] for k in np.unique(piece)]


def _connected(mesh: Mesh, faces: I64) -> I64:
    """(F,) the connected piece that each of the faces belongs to."""
    a, b, c = mesh.faces[faces].T
    links = coo_array((np.ones(2 * len(a), np.int8), (np.r_[a, b], np.r_[b, c])), shape=(len(mesh.vertices),) * 2)
    return np.asarray(connected_components(links, directed=False)[1][a], np.int64)


def behind(mesh: Mesh, plates: Sequence[Plate]) -> tuple[Mesh, list[F64]]:
    """The mesh with poles moved behind the plates that they carry, and by how much (3,) for each plate."""
    vertices, moved = mesh.vertices.astype(np.float64), []
    poles = [np.unique(mesh.faces[piece]) for piece in pieces(mesh, CODE["pole"])]
    for plate in plates:
        moved.append(np.zeros(3))
        for own in poles:
            d = vertices[own] - plate.centre
            beside = d[np.abs(d[:, 2]) < 1.0]
            if not len(beside) or abs(float(np.median(beside @ plate.across))) > plate.width / 2:
                continue
            front = float((beside @ plate.normal).max()) + SHEET + 0.005
            if 0 < front < MOST:
                moved[-1] = -front * plate.normal
                vertices[own] += moved[-1]
    return replace(mesh, vertices=vertices.astype(np.float32)), moved


def cleared(mesh: Mesh, plates: Sequence[Plate], cell: Cell | None = None) -> Mesh:
    """The mesh without surfaces that a plate's points made around it; what has a class of its own stays.

    What lies before the plate goes, and so do scraps beside it that hang on nothing else. Edges on the borders of the
    tile's `cell` stay, since the neighbour has them, too.
    """
    free = np.ones(len(mesh), bool) if mesh.classification is None else mesh.classification == 0
    gone = np.zeros(len(mesh), bool)
    corners = mesh.corners
    for plate in plates:
        far = np.linalg.norm(corners - plate.centre, axis=2).min(axis=1)
        near = np.flatnonzero(free & (far < plate.width + plate.height + BEFORE))
        places = np.einsum("sk,fkc->fsc", _OVER, corners[near]) - plate.centre
        flat, off = np.stack([places @ plate.across, places[..., 2]], axis=-1), places @ plate.normal
        within = inside(flat.reshape(-1, 2), plate.outline, BESIDE).reshape(off.shape)
        gone[near] |= (within & (off > -BEHIND) & (off < BEFORE)).any(axis=1)
    kept = mesh.keep(~gone | (on_border(mesh, cell)[mesh.faces].sum(axis=1) > 1))
    return kept.keep(~_scraps(kept, plates, cell))


def _scraps(mesh: Mesh, plates: Sequence[Plate], cell: Cell | None) -> Bools:
    """(F,) connected pieces without a class of which all lies within reach of a plate, and none on a border."""
    free = np.arange(len(mesh)) if mesh.classification is None else np.flatnonzero(mesh.classification == 0)
    piece, out, on = _connected(mesh, free), np.zeros(len(mesh), bool), on_border(mesh, cell)
    for plate in plates:
        reach = np.hypot(plate.width, plate.height) / 2 + BEFORE
        beyond = (on | (np.linalg.norm(mesh.vertices - plate.centre, axis=1) > reach))[mesh.faces[free]].any(axis=1)
        out[free] |= np.bincount(piece, beyond, minlength=len(mesh.vertices))[piece] == 0
    return out


def with_plates(mesh: Mesh, plates: Sequence[Plate]) -> Mesh:
    """The mesh with the sheets of plates."""
    vertices, faces = primitives.join([(mesh.vertices.astype(np.float64), mesh.faces), *map(sheet, plates)])
    classification = np.full(len(faces), CODE["road_sign"], np.uint8)
    classification[: len(mesh)] = 0 if mesh.classification is None else mesh.classification
    return Mesh(mesh.frame, vertices.astype(np.float32), faces, classification=classification)
