"""Foliage: leaf cards instead of the closed surface where rays of the scanner pass through vegetation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, Bools, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import link_or_copy

if TYPE_CHECKING:
    from scan2sim.pipeline.geometry.leaf_cards import Rays

BORDER_MARGIN_M = 1.0
"""Distance from the border of a tile within which the closed surface is kept, so that it joins the neighbour's."""
ROUNDS = 2
"""Rounds of ray casting: surface behind removed surface is reached in the next one."""
FURNITURE_DISTANCE_M = 0.15
"""Points nearer than this to a modelled trunk are no leaves."""
MAX_RAYS = 3_000_000
"""Rays beyond that number are left out, evenly."""
MORE_CARDS = 40_000
"""Number of cards beyond those that need the triangles of the removed surface."""
CELL_GROWTH, MAX_GROWTH = 1.25, 2.0
"""Factor by which cells grow while there are more than the allowed cards, and largest product of these factors."""


class FoliageContext(Context):
    """The tile's cell, if it has neighbours."""

    cell: TileCell | None = None


class FoliageParams(Params):
    """Where foliage is open, and how fine.

    Attributes:
        when: "auto": leaf cards if points have times and the scanner's path is known; "never": vegetation is a closed
            surface.
        min_hit_ratio: share of the rays reaching a place that must end there for its closed surface to be kept.
        size: size of the cells that get a card, metres; up to twice that if there would be too many cards.
        context: the tile's cell.
    """

    when: Literal["auto", "never"] = "never"
    min_hit_ratio: float = Field(0.8, ge=0, le=1)
    size: float = Field(0.2, ge=0.05, le=2)
    context: FoliageContext = FoliageContext()


def foliage(inputs: Inputs, params: FoliageParams, out: Path, report: Report) -> Done:
    """Replace the parts of the vegetation `mesh` that rays pass through by leaf cards.

    Inputs: `mesh`, closed; the tile's own classified `cloud`; `path` of the scanner (optional). Without a path and the
    times of points there are no rays: the mesh is kept, with a warning.
    Metrics: `faces_in`, `faces`; `removed`, faces of the closed surface that cards replace; `cards`; `size_m` of their
    cells; `reason` why there are no rays, or "".
    """
    from scan2sim.pipeline.geometry.leaf_cards import Rays
    from scan2sim.pipeline.lidar.sweeps import scanner_origins

    report(0.0, "reading")
    mesh, cloud = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"])
    origins, reason = np.zeros((0, 3)), "the tile has no trajectory of a scanner"
    if "path" in inputs:
        origins, reason = scanner_origins(cloud, Trajectory.load(inputs["path"]))
    assert cloud.classification is not None
    leaves = cloud.xyz[group_of()[cloud.classification] == GROUPS.index("vegetation")]
    if reason or not len(mesh) or not len(leaves):
        link_or_copy(inputs["mesh"], out / "mesh.npz")
        warnings = [f"vegetation stays a closed surface: {reason}"] if reason else []
        metrics: dict[str, Any] = {"faces_in": len(mesh), "faces": len(mesh), "removed": 0, "cards": 0}
        return Done({"mesh": out / "mesh.npz"}, metrics | {"reason": reason}, warnings)
    known = np.flatnonzero(np.isfinite(origins[:, 0]))
    known = known[:: -(-len(known) // MAX_RAYS)]
    rays = Rays(origins[known], cloud.xyz[known].astype(np.float64))
    report(0.1, "casting rays")
    kept = _closed_part(mesh, rays, params)
    report(0.5, "placing cards")
    leaves = leaves[_may_open(leaves, mesh, params.context.cell)]
    leaves = leaves[_distance(leaves, mesh.keep(_is_furniture(mesh))) > FURNITURE_DISTANCE_M]
    leaves = leaves[_distance(leaves, kept) > params.size / 2]
    cards, size = _cards(leaves, rays, params, mesh, MORE_CARDS + (len(mesh) - len(kept)) // 2)
    together = _join(kept, cards)
    together.save(out / "mesh.npz")
    metrics = {
        "faces_in": len(mesh),
        "faces": len(together),
        "removed": len(mesh) - len(kept),
        "cards": len(cards) // 2,
        "size_m": round(size, 3),
        "reason": "",
    }
    return Done({"mesh": out / "mesh.npz"}, metrics)


def _closed_part(mesh: Mesh, rays: Rays, params: FoliageParams) -> Mesh:
    """The faces of the closed surface that most rays end at, and those at the tile's borders."""
    from scan2sim.pipeline.lidar.free_space import passed_faces

    kept = mesh
    for _ in range(ROUNDS):
        passed = passed_faces(kept, rays.start, rays.end, params.min_hit_ratio)
        may_open = _may_open(kept.corners.mean(axis=1), kept, params.context.cell)
        kept = kept.keep(~passed | ~may_open | _is_furniture(kept))
    return kept


def _cards(leaves: F32, rays: Rays, params: FoliageParams, mesh: Mesh, max_count: int) -> tuple[Mesh, float]:
    """Cards at the points `leaves` (N, 3), at most `max_count`, and the size of their cells, metres."""
    from scan2sim.pipeline.geometry.leaf_cards import leaf_cards
    from scan2sim.pipeline.lidar.cell_rays import Cells, trace

    size = params.size
    if not len(leaves):
        return Mesh(mesh.frame, mesh.vertices[:0], mesh.faces[:0]), size
    cells = Cells.of(leaves, size)
    while len(cells) > max_count and size * CELL_GROWTH <= MAX_GROWTH * params.size:
        size *= CELL_GROWTH
        cells = Cells.of(leaves, size)
    first, ray = trace(cells, rays.start, rays.end)
    return leaf_cards(mesh.frame, leaves, cells.points(), rays, (first, ray), size, max_count), size


def _may_open(places: npt.NDArray[np.floating], mesh: Mesh, cell: TileCell | None) -> Bools:
    """(N,) bool, False for places (N, 3), local metres, beyond or near the tile's borders."""
    if cell is None:
        return np.ones(len(places), bool)
    return cell.cell.outside(places[:, :2] + np.asarray(mesh.frame.origin)[:2]) < -BORDER_MARGIN_M


def _is_furniture(mesh: Mesh) -> Bools:
    """(F,) bool, True for faces of street furniture, which have a class."""
    return np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification > 0


def _distance(points: F32, mesh: Mesh) -> F32:
    """(N,) distances in metres of points (N, 3) from a mesh, inf if it is empty."""
    import open3d as o3d

    if not len(mesh) or not len(points):
        return np.full(len(points), np.inf, np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    return np.asarray(scene.compute_distance(np.ascontiguousarray(points)).numpy())


def _join(mesh: Mesh, cards: Mesh) -> Mesh:
    """Concatenate the remaining surface and the cards (class 0)."""
    codes = mesh.classification
    return Mesh(
        mesh.frame,
        np.concatenate([mesh.vertices, cards.vertices]),
        np.concatenate([mesh.faces, cards.faces + len(mesh.vertices)]).astype(np.int32),
        classification=None if codes is None else np.concatenate([codes, np.zeros(len(cards), np.uint8)]),
    )


FOLIAGE = Step("foliage", 1, foliage, FoliageParams, memory=(0.6, 60))
