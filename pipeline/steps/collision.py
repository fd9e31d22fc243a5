"""Collision: what bodies touch, apart from what is seen, and how far it lies from the cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, SURFACES, name_of
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.parameters import Place, Seed
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, U8, Frame, Mesh, PointCloud
from scan2sim.pipeline.tiling.voronoi_cell import Cell

SAMPLES = 100_000  # points at which the distance to what is seen is measured
POINTS = 1_000_000  # of the cloud, at most, that the ground is fitted to
MOST = 200_000  # triangles, whatever the borders need
GROUND = 0.6  # of the triangles, at most
DENSE = 10  # triangles a square metre: finer ones would follow the points' noise
VOTERS = 9  # points that tell a triangle's class
SOLID = {"building": CODE["building"], "vegetation": CODE["high_vegetation"], "vehicle": CODE["vehicle"]}


class CollisionParams(Params):
    """What bodies collide with.

    Attributes:
        triangles: at most; physics engines stay interactive up to about 50 thousand.
        vegetation: whether plants are solid too; trunks always are, and plants where nothing else is.
        seed: of the points at which the deviation is measured.
        place: the tile's (x, y), world metres, where it meets others: its borders with them stay as they are; set by
            the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    triangles: int = Field(50_000, ge=100, le=MOST)
    vegetation: bool = False
    seed: Seed = 0
    place: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def collision(inputs: Inputs, params: CollisionParams, out: Path, report: Report) -> Done:
    """Make the ground, walls, poles and trunks that bodies collide with; leaves are passable.

    The ground (`terrain`) is decimated, and its heights are fitted to the points of `cloud` (the ground's own, as
    scanned; optional): smooth, and nearer to what was measured than what is seen. `building` and `vehicle` (and
    `vegetation`, if asked) share what is left of the triangles. Of open edges, those on borders with other tiles
    stay as they are, vertex for vertex; all others are thinned. Street furniture stays as it is, so that its poles and
    trunks can be told apart as cylinders (`pipeline.geometry.cylinders`); where it would take more than half the
    budget, it is
    simplified as well. Where neither ground nor building has a face, plants are solid, and a warning says so.

    File: `mesh`, with a class code for every face: of the ground, that of the points around it. Facts in metres:
    `ground_m`, heights between the cloud's points and the ground; `deviation_m`, from what is seen to what is touched.

    Raises:
        DataError: no mesh has a face.
        StepError: the borders alone need over 200,000 triangles.
    """
    from scan2sim.pipeline.geometry.cylinders import told_apart
    from scan2sim.pipeline.tiling.borders.open_edges import on_border

    meshes = {group: Mesh.load(inputs[group]) for group in SURFACES if group in inputs}
    frame = next(iter(meshes.values())).frame
    cell = None if params.place is None else Cell(params.place, params.neighbours)
    points = _ground_points(inputs, params.seed)
    terrain = meshes.pop("terrain", _joined(frame, []))
    parted = {group: _parted(mesh, SOLID[group]) for group, mesh in meshes.items()}
    things = _joined(frame, [things for _, things in parted.values()])
    hard = [surface for group, (surface, _) in parted.items() if group != "vegetation"]
    plants_alone = not any(map(len, (terrain, things, *hard)))
    solid = params.vegetation or plants_alone
    surfaces = [surface for group, (surface, _) in parted.items() if group != "vegetation" or solid]
    if len(things) > params.triangles / 2:
        surfaces, things = [*surfaces, things], _joined(frame, [])
    whole = _joined(frame, [terrain, *surfaces, things])
    if not len(whole):
        raise DataError(
            "collision",
            "there is no surface to collide with (terrain, building and vegetation are empty)",
            "Check the cloud's classes, and voxel, poisson, trim, islands where set",
        )
    report(0.1, f"{len(whole):,} triangles")
    ground = _ground(terrain, points, params, cell)
    report(0.5, "walls")
    small = _joined(frame, [ground, *_walls(surfaces, params.triangles - len(ground) - len(things), cell), things])
    if len(small) > MOST:
        raise StepError(
            "collision",
            f"{len(small):,} triangles are left where {MOST:,} are allowed",
            "Raise islands.min_area, so that less of the surface is crumbs, or cut smaller tiles",
        )
    report(0.8, "deviation")
    small.save(out / "collision.npz")
    facts: dict[str, Any] = {
        "triangles_in": len(whole),
        "triangles": len(small),
        "ground_triangles": len(ground),
        "cylinders": len(told_apart(things)[0]),
        "border_vertices": int(on_border(small, cell).sum()),
        "deviation_m": deviation(whole, small, params.seed),
        "ground_m2": _areas(ground),
    }
    if points is not None and len(ground):
        facts["ground_m"] = _off(ground, points.xyz)
    warnings = []
    if plants_alone and not params.vegetation:
        warnings.append("terrain and building are empty: plants are solid, as there is nothing else to collide with")
    if len(small) > params.triangles:
        warnings.append(f"{len(small):,} triangles where {params.triangles:,} are wanted: the borders need them")
    return Done({"mesh": out / "collision.npz"}, facts, warnings)


def _ground_points(inputs: Inputs, seed: int) -> PointCloud | None:
    """Points of the ground as scanned, not too many."""
    if "cloud" not in inputs:
        return None
    cloud = PointCloud.load(inputs["cloud"])
    if len(cloud) > POINTS:
        cloud = cloud.take(np.sort(np.random.default_rng(seed).choice(len(cloud), POINTS, replace=False)))
    return cloud


def _ground(terrain: Mesh, points: PointCloud | None, params: CollisionParams, cell: Cell | None) -> Mesh:
    """The ground, light and smooth, with its classes."""
    from scan2sim.pipeline.terrain.ground_fit import fitted
    from scan2sim.pipeline.tiling.borders.open_edges import on_border, thinned

    ground = thinned(terrain, min(round(GROUND * params.triangles), _enough(terrain)), on_border(terrain, cell))
    if points is not None:
        ground = fitted(ground, points.xyz, on_border(ground, cell))
    return replace(ground, classification=_classes(ground, points))


def _walls(surfaces: Sequence[Mesh], budget: int, cell: Cell | None) -> list[Mesh]:
    """What stands, thinned, the triangles shared out by area; each of one class."""
    from scan2sim.pipeline.tiling.borders.open_edges import on_border, thinned

    wanted = [(mesh, _enough(mesh)) for mesh in surfaces if len(mesh)]
    share = min(1.0, max(0, budget) / max(1, sum(count for _, count in wanted)))
    return [_of_class(thinned(mesh, int(share * count), on_border(mesh, cell)), _code(mesh)) for mesh, count in wanted]


def _enough(mesh: Mesh) -> int:
    """Triangles that a surface needs."""
    return max(100, round(DENSE * float(mesh.face_area.sum())))


def _of_class(mesh: Mesh, code: int) -> Mesh:
    return replace(mesh, classification=np.full(len(mesh), code, np.uint8))


def _code(mesh: Mesh) -> int:
    """The class that most faces have."""
    return int(np.bincount(np.asarray(mesh.classification)).argmax())


def _joined(frame: Frame, meshes: Sequence[Mesh]) -> Mesh:
    """Meshes as one, with their classes."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)]
    codes = [np.zeros(len(m), np.uint8) if m.classification is None else m.classification for m in meshes]
    return Mesh(
        frame,
        np.concatenate([np.zeros((0, 3), np.float32), *(mesh.vertices for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32),
        classification=np.concatenate([np.zeros(0, np.uint8), *codes]),
    )


def _parted(mesh: Mesh, code: int) -> tuple[Mesh, Mesh]:
    """The surface, given its class, and the street furniture, which has classes already."""
    own = np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification > 0
    return _of_class(mesh.keep(~own), code), mesh.keep(own)


def _classes(ground: Mesh, points: PointCloud | None) -> U8:
    """(F,) class codes: what most of the points nearest to a triangle's middle are."""
    from scipy.spatial import cKDTree

    if points is None or points.classification is None or not len(points) or not len(ground):
        return np.full(len(ground), CODE["terrain"], np.uint8)
    k = min(VOTERS, len(points))
    _, near = cKDTree(points.xyz).query(ground.corners.mean(axis=1), k=k, workers=-1)
    votes = points.classification[near.reshape(len(ground), k)]
    codes = np.unique(votes)
    return codes[np.argmax([(votes == code).sum(axis=1) for code in codes], axis=0)]


def _areas(ground: Mesh) -> dict[str, float]:
    """Square metres of the ground by class."""
    assert ground.classification is not None
    codes, area = np.unique(ground.classification), ground.face_area
    return {name_of(int(code)): round(float(area[ground.classification == code].sum()), 1) for code in codes}


def _off(ground: Mesh, points: F32) -> dict[str, float]:
    """Heights between points of the cloud and the ground in metres; all within 15 cm of it count."""
    from scan2sim.pipeline.terrain.ground_fit import off_ground

    _, _, above = off_ground(ground, points)
    return _figures(np.abs(above)) if len(above) else {}


def _figures(distance: npt.NDArray[np.floating]) -> dict[str, float]:
    return {
        "mean": round(float(distance.mean()), 4),
        "p95": round(float(np.percentile(distance, 95)), 4),
        "max": round(float(distance.max()), 4),
    }


def deviation(source: Mesh, small: Mesh, seed: int) -> dict[str, float]:
    """Distances in metres from points of `source`, drawn evenly over its area, to `small`."""
    import open3d as o3d

    rng = np.random.default_rng(seed)
    area = source.face_area.astype(np.float64)
    face = rng.choice(len(source), SAMPLES, p=area / area.sum())
    r, s = np.sqrt(rng.random((SAMPLES, 1))), rng.random((SAMPLES, 1))
    a, b, c = np.moveaxis(source.corners[face], 1, 0)
    points = (1 - r) * a + r * (1 - s) * b + r * s * c  # uniform in a triangle: Osada et al. 2002
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(small.vertices), o3d.core.Tensor.from_numpy(small.faces.astype(np.uint32))
    )
    return _figures(scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy())


COLLISION = Step("collision", 3, collision, CollisionParams)
