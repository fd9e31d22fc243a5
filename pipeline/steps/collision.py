"""Collision: a simplified collision mesh, separate from the visual meshes, and its deviation from the cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, SURFACES, name_of
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, U8, Frame, Mesh, PointCloud
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.geometry.rectilinear_solids import is_rectilinear
from scan2sim.pipeline.geometry.surface_distance import deviation, statistics

MAX_GROUND_POINTS = 1_000_000  # points of the cloud that the ground is fitted to
MAX_TRIANGLES = 200_000  # limit that also includes what the tile borders need
GROUND_FRACTION = 0.6  # largest part of the triangles that the ground gets
MAX_TRIANGLES_PER_M2 = 10  # smaller triangles would follow the points' noise
CLASS_NEIGHBOURS = 9  # nearest points that vote for a triangle's class
SURFACE_CLASS = {
    "building": CODE["building"], "vegetation": CODE["high_vegetation"], "vehicle": CODE["vehicle"],
    "furniture": CODE["furniture"],
}  # fmt: skip
"""Class of each surface beside the ground; ceilings don't collide."""


class CollisionParams(Params):
    """The collision mesh.

    Attributes:
        triangles: maximum number of triangles; physics engines stay interactive up to about 50 thousand.
        vegetation: whether plants collide too; trunks always do, and plants do if there is no other surface.
        seed: random seed of the points at which the deviation is measured.
        context: the tile's cell, if it has neighbours; borders with them are not simplified.
    """

    triangles: int = Field(50_000, ge=100, le=MAX_TRIANGLES)
    vegetation: bool = False
    seed: Seed = 0
    context: TileCell | None = None


def collision(inputs: Inputs, params: CollisionParams, out: Path, report: Report) -> Done:
    """Make the collision mesh: ground, walls, poles and trunks; leaves don't collide.

    The ground (`terrain`) is decimated, and its heights are fitted to the points of `cloud` (scanned ground points;
    optional): it is smooth, and nearer to the measurement than the visual mesh. `building` and `vehicle` (and
    `vegetation`, if enabled) share the remaining triangles. Open edges on borders with other tiles are kept vertex for
    vertex; all others are simplified. Ceilings don't collide. Street furniture is not simplified, so that its poles
    and trunks can be replaced by cylinders (`pipeline.geometry.cylinders`), unless it takes more than half the budget.
    With `instances` (GeoJSON), parked vehicles without a surface, which splats show, are boxes.
    If neither ground nor building has a face, plants collide, with a warning.

    File: `mesh`, with a class code per face (ground: class of the nearest points). Metrics in metres: `ground_m`,
    height differences between the cloud and the ground; `deviation_m`, from the visual meshes to the collision mesh.

    Raises:
        DataError: no mesh has a face.
        StepError: the borders alone need over 200,000 triangles.
    """
    from scan2sim.pipeline.geometry.cylinders import split_cylinders
    from scan2sim.pipeline.tiling.borders.open_edges import on_border

    meshes = {group: Mesh.load(inputs[group]) for group in SURFACES if group in inputs and group != "ceiling"}
    frame = next(iter(meshes.values())).frame
    cell = params.context.cell if params.context else None
    points = _ground_points(inputs, params.seed)
    terrain = meshes.pop("terrain", _joined(frame, []))
    separated = {group: _split_furniture(mesh, SURFACE_CLASS[group]) for group, mesh in meshes.items()}
    furniture = _joined(frame, [furniture for _, furniture in separated.values()])
    hard = [surface for group, (surface, _) in separated.items() if group != "vegetation"]
    only_plants = not any(map(len, (terrain, furniture, *hard)))
    plants_collide = params.vegetation or only_plants
    surfaces = [surface for group, (surface, _) in separated.items() if group != "vegetation" or plants_collide]
    if len(furniture) > params.triangles / 2:
        surfaces, furniture = [*surfaces, furniture], _joined(frame, [])
    visual = _joined(frame, [terrain, *surfaces, furniture])
    if not len(visual):
        raise DataError(
            "collision",
            "there is no surface to collide with (terrain, building and vegetation are empty)",
            "Check the cloud's classes, and the settings of voxel, poisson, trim and islands",
        )
    parked = _parked(inputs, frame, cell)
    report(0.1, f"{len(visual):,} triangles")
    ground = _ground(terrain, points, params, cell)
    report(0.5, "walls")
    collision_mesh = _joined(
        frame, [ground, *_walls(surfaces, params.triangles - len(ground) - len(furniture), cell), furniture, parked]
    )
    if len(collision_mesh) > MAX_TRIANGLES:
        raise StepError(
            "collision",
            f"{len(collision_mesh):,} triangles after simplification, the limit is {MAX_TRIANGLES:,}",
            "Raise islands.min_area to remove more small pieces, or cut smaller tiles",
        )
    report(0.8, "deviation")
    collision_mesh.save(out / "collision.npz")
    metrics: dict[str, Any] = {
        "triangles_in": len(visual),
        "triangles": len(collision_mesh),
        "ground_triangles": len(ground),
        "cylinders": len(split_cylinders(furniture)[0]),
        "border_vertices": int(on_border(collision_mesh, cell).sum()),
        "deviation_m": deviation(visual, collision_mesh, params.seed),
        "ground_m2": _areas(ground),
    }
    if points is not None and len(ground):
        metrics["ground_m"] = _height_errors(ground, points.xyz)
    warnings = []
    if only_plants and not params.vegetation:
        warnings.append(
            "terrain and building are empty: plants are solid, as there is no other surface to collide with"
        )
    if len(collision_mesh) > params.triangles:
        warnings.append(
            f"{len(collision_mesh):,} triangles instead of {params.triangles:,}: tile borders can't be simplified"
        )
    return Done({"mesh": out / "collision.npz"}, metrics, warnings)


def _parked(inputs: Inputs, frame: Frame, cell: Cell | None) -> Mesh:
    """Boxes of the parked vehicles among `instances` whose middle is in the tile's cell."""
    from scan2sim.pipeline.dynamic_objects.instance_boxes import boxes, is_parked

    found = boxes(inputs["instances"], frame, is_parked) if "instances" in inputs else _joined(frame, [])
    if cell is not None and len(found):
        middles = found.vertices.reshape(-1, 8, 3)[..., :2].mean(axis=1) + np.asarray(frame.origin[:2])
        found = found.keep(np.repeat(cell.outside(middles) <= 0, len(found) // len(middles)))
    return _of_class(found, CODE["vehicle"])


def _ground_points(inputs: Inputs, seed: int) -> PointCloud | None:
    """Scanned ground points, a random subset if there are too many."""
    if "cloud" not in inputs:
        return None
    cloud = PointCloud.load(inputs["cloud"])
    if len(cloud) > MAX_GROUND_POINTS:
        cloud = cloud.take(np.sort(np.random.default_rng(seed).choice(len(cloud), MAX_GROUND_POINTS, replace=False)))
    return cloud


def _ground(terrain: Mesh, points: PointCloud | None, params: CollisionParams, cell: Cell | None) -> Mesh:
    """Ground of the collision mesh: simplified, fitted to the points, with classes."""
    from scan2sim.pipeline.terrain.ground_fit import fit_heights
    from scan2sim.pipeline.tiling.borders.open_edges import decimate_keeping_borders, on_border

    ground = decimate_keeping_borders(
        terrain, min(round(GROUND_FRACTION * params.triangles), _triangles_needed(terrain)), on_border(terrain, cell)
    )
    if points is not None:
        ground = fit_heights(ground, points.xyz, on_border(ground, cell))
    return replace(ground, classification=_classes(ground, points))


def _walls(surfaces: Sequence[Mesh], budget: int, cell: Cell | None) -> list[Mesh]:
    """Surfaces other than the ground, simplified; triangles are distributed by area, each surface has one class."""
    from scan2sim.pipeline.tiling.borders.open_edges import decimate_keeping_borders, on_border

    needed = [(mesh, _triangles_needed(mesh)) for mesh in surfaces if len(mesh)]
    share = min(1.0, max(0, budget) / max(1, sum(count for _, count in needed)))
    return [
        _of_class(decimate_keeping_borders(mesh, int(share * count), on_border(mesh, cell)), _code(mesh))
        for mesh, count in needed
    ]


def _triangles_needed(mesh: Mesh) -> int:
    """Number of triangles that represent a surface well enough; slabs and boxes need all that they have."""
    if is_rectilinear(mesh):
        return len(mesh)
    return max(100, round(MAX_TRIANGLES_PER_M2 * float(mesh.face_area.sum())))


def _of_class(mesh: Mesh, code: int) -> Mesh:
    return replace(mesh, classification=np.full(len(mesh), code, np.uint8))


def _code(mesh: Mesh) -> int:
    """Most frequent class of the faces."""
    return int(np.bincount(np.asarray(mesh.classification)).argmax())


def _joined(frame: Frame, meshes: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes with their classes."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)]
    codes = [np.zeros(len(m), np.uint8) if m.classification is None else m.classification for m in meshes]
    return Mesh(
        frame,
        np.concatenate([np.zeros((0, 3), np.float32), *(mesh.vertices for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32),
        classification=np.concatenate([np.zeros(0, np.uint8), *codes]),
    )


def _split_furniture(mesh: Mesh, code: int) -> tuple[Mesh, Mesh]:
    """The surface, labelled with `code`, and the street furniture (faces that have a class already)."""
    own = np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification > 0
    return _of_class(mesh.keep(~own), code), mesh.keep(own)


def _classes(ground: Mesh, points: PointCloud | None) -> U8:
    """Class codes (F,): majority of the points nearest to a triangle's centroid."""
    from scipy.spatial import cKDTree

    if points is None or points.classification is None or not len(points) or not len(ground):
        return np.full(len(ground), CODE["terrain"], np.uint8)
    k = min(CLASS_NEIGHBOURS, len(points))
    _, near = cKDTree(points.xyz).query(ground.corners.mean(axis=1), k=k, workers=-1)
    votes = points.classification[near.reshape(len(ground), k)]
    codes = np.unique(votes)
    return codes[np.argmax([(votes == code).sum(axis=1) for code in codes], axis=0)]


def _areas(ground: Mesh) -> dict[str, float]:
    """Area of the ground by class, m2."""
    assert ground.classification is not None
    codes, area = np.unique(ground.classification), ground.face_area
    return {name_of(int(code)): round(float(area[ground.classification == code].sum()), 1) for code in codes}


def _height_errors(ground: Mesh, points: F32) -> dict[str, float]:
    """Statistics of the height difference between points and ground in metres, for points within 15 cm of it."""
    from scan2sim.pipeline.terrain.ground_fit import heights_above_ground

    _, _, above = heights_above_ground(ground, points)
    return statistics(np.abs(above)) if len(above) else {}


COLLISION = Step("collision", 4, collision, CollisionParams)
