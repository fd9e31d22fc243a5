"""Attaches sign panels fitted to photos to a mesh: panels added, poles moved behind them, smeared surfaces removed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.furniture.classify import PANEL_THICKNESS_M, panel_mesh
from scan2sim.pipeline.furniture.sign_panels import SignPanel, inside
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.tiling.borders.open_edges import on_border

SMEAR_FRONT_M, SMEAR_BACK_M, SMEAR_SIDE_M = 0.5, 0.05, 0.1
"""Metres in front of, behind and beside a panel within which surfaces are reconstructions of its own points."""
POLE_MAX_SHIFT_M = 0.3
"""Largest distance by which a pole is moved behind its panel."""
_FACE_SAMPLES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6
"""Barycentric points at which a face is sampled."""


def without_panels(mesh: Mesh, panels: Sequence[SignPanel]) -> Mesh:
    """The mesh without the given panels."""
    removed = np.zeros(len(mesh), bool)
    for component in components(mesh, CODE["road_sign"]):
        corners = mesh.vertices[np.unique(mesh.faces[component])]
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        removed[component] = any(np.linalg.norm(middle - panel.centre) < 0.05 for panel in panels)
    return mesh.keep(~removed)


def components(mesh: Mesh, code: int) -> list[I64]:
    """Faces of each connected component of a class."""
    if mesh.classification is None:
        return []
    faces = np.flatnonzero(mesh.classification == code)
    component = _component_of(mesh, faces)
    return [faces[component == k] for k in np.unique(component)]


def _component_of(mesh: Mesh, faces: I64) -> I64:
    """(F,) connected component of each of the faces."""
    a, b, c = mesh.faces[faces].T
    links = coo_array((np.ones(2 * len(a), np.int8), (np.r_[a, b], np.r_[b, c])), shape=(len(mesh.vertices),) * 2)
    return np.asarray(connected_components(links, directed=False)[1][a], np.int64)


def move_poles_behind(mesh: Mesh, panels: Sequence[SignPanel]) -> tuple[Mesh, list[F64]]:
    """The mesh with poles moved behind the panels that they carry, and the shift (3,) for each panel."""
    vertices, shifts = mesh.vertices.astype(np.float64), []
    poles = [np.unique(mesh.faces[component]) for component in components(mesh, CODE["pole"])]
    for panel in panels:
        shifts.append(np.zeros(3))
        for pole in poles:
            d = vertices[pole] - panel.centre
            beside = d[np.abs(d[:, 2]) < 1.0]
            if not len(beside) or abs(float(np.median(beside @ panel.across))) > panel.width / 2:
                continue
            front = float((beside @ panel.normal).max()) + PANEL_THICKNESS_M + 0.005
            if 0 < front < POLE_MAX_SHIFT_M:
                shifts[-1] = -front * panel.normal
                vertices[pole] += shifts[-1]
    return replace(mesh, vertices=vertices.astype(np.float32)), shifts


def without_smear(mesh: Mesh, panels: Sequence[SignPanel], cell: Cell | None = None) -> Mesh:
    """The mesh without the surfaces that were reconstructed from a panel's points; faces with a class are kept.

    Removes faces in front of the panels, and components beside them that are attached to nothing else. Edges on the
    borders of the tile's `cell` are kept, as the neighbouring tile has them, too.
    """
    unclassified = np.ones(len(mesh), bool) if mesh.classification is None else mesh.classification == 0
    removed = np.zeros(len(mesh), bool)
    corners = mesh.corners
    for panel in panels:
        distance = np.linalg.norm(corners - panel.centre, axis=2).min(axis=1)
        near = np.flatnonzero(unclassified & (distance < panel.width + panel.height + SMEAR_FRONT_M))
        points = np.einsum("sk,fkc->fsc", _FACE_SAMPLES, corners[near]) - panel.centre
        flat, offset = np.stack([points @ panel.across, points[..., 2]], axis=-1), points @ panel.normal
        within = inside(flat.reshape(-1, 2), panel.outline, SMEAR_SIDE_M).reshape(offset.shape)
        removed[near] |= (within & (offset > -SMEAR_BACK_M) & (offset < SMEAR_FRONT_M)).any(axis=1)
    kept = mesh.keep(~removed | (on_border(mesh, cell)[mesh.faces].sum(axis=1) > 1))
    return kept.keep(~_detached(kept, panels, cell))


def _detached(mesh: Mesh, panels: Sequence[SignPanel], cell: Cell | None) -> Bools:
    """(F,) faces of unclassified components that lie completely near a panel and don't touch a border."""
    free = np.arange(len(mesh)) if mesh.classification is None else np.flatnonzero(mesh.classification == 0)
    component, out, on = _component_of(mesh, free), np.zeros(len(mesh), bool), on_border(mesh, cell)
    for panel in panels:
        radius = np.hypot(panel.width, panel.height) / 2 + SMEAR_FRONT_M
        beyond = (on | (np.linalg.norm(mesh.vertices - panel.centre, axis=1) > radius))[mesh.faces[free]].any(axis=1)
        out[free] |= np.bincount(component, beyond, minlength=len(mesh.vertices))[component] == 0
    return out


def with_panels(mesh: Mesh, panels: Sequence[SignPanel]) -> Mesh:
    """The mesh with the panels added."""
    vertices, faces = primitives.join([(mesh.vertices.astype(np.float64), mesh.faces), *map(panel_mesh, panels)])
    classification = np.full(len(faces), CODE["road_sign"], np.uint8)
    classification[: len(mesh)] = 0 if mesh.classification is None else mesh.classification
    return Mesh(mesh.frame, vertices.astype(np.float32), faces, classification=classification)
