"""Navigation: occupancy maps for Nav2, a spawn pose in free space, and a PCD of the surface for localization."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES, group_of
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.parameters import Coordinate
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, Bools, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io.worlds.scene import NAVIGATION_FILE
from scan2sim.pipeline.simulation import ground_origin

MAX_CLOUD_POINTS = 10_000_000
BLOCK_M = 0.5
"""Points are queried block by block: neighbours use the same part of the search tree, which is four times as fast."""
NEAR_M = 0.5
"""Surfaces farther than this from all points, such as floors under furniture, get the median intensity: a search for
their nearest points took most of the step's time."""
INTENSITY_SCALE = 257.0
"""Intensities of clouds (16 bits) per level of the PCD's, which are 0 to 255."""
MAX_FLOAT32_M = 10_000.0
"""Coordinates above this are written as float64: float32 would round them to a millimetre."""
SOFT = ("mesh.ceiling", "mesh.vegetation")
"""Inputs with surfaces that do not collide."""
Row = tuple[float, float, float, float]


class NavigationContext(Context):
    """The tile.

    Attributes:
        world_origin: origin of the simulator's world in the CRS, metres; None: that of the input `origin`, or else the
            tile's own.
        T_world_map: rigid transform from the robot's map, in metres, to the CRS; None: not made from a robot's map.
        unit: metres per unit of the robot's map.
        spacing: distance of the points of the PCD, metres.
        has_floor: whether the ground is a complete floor (step `floor`), so that nothing else is floor.
    """

    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    T_world_map: tuple[Row, Row, Row, Row] | None = None
    unit: float = 1.0
    spacing: float = 0.1
    has_floor: bool = False


class NavigationParams(Params):
    """Files for navigation.

    Attributes:
        when: "auto": for robots' maps; "always": for all single tiles; "never".
        resolution: side of a cell of the occupancy maps, metres; large worlds get larger cells.
        low: lower limit of the heights above the floor at which surfaces are obstacles, metres; the robot drives over
            what is below.
        high: upper limit of these heights, metres: the top of the robot; the supplied robot is 0.72 m high.
        radius: half the width of the narrowest passage that the robot drives through, metres; floor behind narrower
            ones is unknown. The supplied robot is 0.58 m wide.
        max_step: largest height difference between neighbouring cells of the floor, metres.
        max_slope: steepest floor, degrees.
        context: the tile.
    """

    when: Literal["auto", "always", "never"] = "auto"
    resolution: float = Field(0.05, ge=0.01, le=1)
    low: float = Field(0.1, ge=0.01, le=5)
    high: float = Field(0.75, ge=0.02, le=20)
    radius: float = Field(0.3, ge=0, le=10)
    max_step: float = Field(0.06, ge=0.01, le=1)
    max_slope: float = Field(30.0, ge=1, le=60)
    context: NavigationContext = NavigationContext()


def navigation(inputs: Inputs, params: NavigationParams, out: Path, report: Report) -> Done:
    """Write occupancy maps of the `collision` mesh, a spawn pose, and points of the visual meshes (`mesh.CLASS`).

    The robot starts where the `path` begins, or else at the origin of its map. Intensities are those of the nearest
    points of `cloud` (optional), or its median where none is near. File: `navigation`, a folder with `map.yaml` and
    `map.pgm` (the storey of the start; others: `map_1` ...), `map.pcd` (only for robots' maps, in the map's frame and
    unit), and `navigation.json`: spawn pose and storeys in the frame "world", whose origin in the CRS is
    `world_origin_m`.

    Without a floor that a robot fits on there are no maps and no pose, and a warning.

    Raises:
        SettingError: the height band is empty.
    """
    if params.high <= params.low:
        raise SettingError("navigation.high", "must be above navigation.low", "Heights are metres above the floor")
    folder = out / "navigation"
    folder.mkdir()
    metrics: dict[str, Any] = {}
    warnings: list[str] = []
    try:
        metrics |= _write_maps(inputs, params, folder, report, warnings)
    except DataError as error:  # the points are useful without the maps
        warnings.append(f"no occupancy map: {error.cause}")
    if params.context.T_world_map is not None:
        report(0.6, "points")
        metrics["points"] = _write_points(inputs, params.context, folder / "map.pcd")
    return Done({"navigation": folder}, metrics, warnings)


def _write_maps(
    inputs: Inputs, params: NavigationParams, folder: Path, report: Report, warnings: list[str]
) -> dict[str, Any]:
    """Write the occupancy maps and `navigation.json`; returns metrics."""
    from scan2sim.pipeline.io.navigation import nav2_map
    from scan2sim.pipeline.simulation.free_spawn import spawn_pose
    from scan2sim.pipeline.simulation.occupancy import Band, storeys

    mesh, ground = _surfaces(inputs, params.context)
    origin = params.context.world_origin or ground_origin.read(inputs) or mesh.frame.origin
    offset = np.asarray(mesh.frame.origin) - np.asarray(origin)
    starts = _starts(inputs, params.context, mesh)
    report(0.1, "occupancy")
    band = Band(params.low, params.high, params.max_step, params.max_slope, params.radius)
    found = storeys(mesh, starts, band, params.resolution, ground)
    about: list[dict[str, Any]] = []
    for i, storey in enumerate(found):
        file, floor = folder / f"map{f'_{i}' if i else ''}.yaml", storey.height + float(offset[2])
        note = f"frame: world; floor at z = {floor:.2f} m; obstacles {params.low:g} to {params.high:g} m above it"
        nav2_map.write(storey, file, (float(offset[0]), float(offset[1])), note)
        about.append({"map": file.name, "floor_m": round(floor, 3), "free_m2": round(storey.free_m2, 1)})
    chosen = spawn_pose(found[0], starts[0] if len(starts) else None)
    position = (np.asarray(chosen.start.position) + offset).round(4).tolist()
    spawn = {
        "position_m": position,
        "angles_rad": np.round(chosen.start.angles, 6).tolist(),
        "clearance_m": round(chosen.clearance, 2),
    }
    if not chosen.fits:
        warnings.append(
            f"the spawn pose is only {chosen.clearance:.2f} m from obstacles: no room for the supplied robot"
        )
    elif not chosen.turns:
        warnings.append(f"the supplied robot can't turn at its spawn pose, {chosen.clearance:.2f} m from obstacles")
    body = {
        "frame": "world", "world_origin_m": list(origin), "spawn": spawn, "storeys": about, "band_m": asdict(band)
    }  # fmt: skip
    (folder / NAVIGATION_FILE).write_text(json.dumps(body, indent=2) + "\n", encoding="utf-8")
    return {"storeys": about, "spawn": spawn, "resolution_m": round(found[0].grid.cell, 4)}


def _surfaces(inputs: Inputs, context: NavigationContext) -> tuple[Mesh, Bools | None]:
    """The collision mesh, and whether each face may be floor (None: every level one).

    Ceilings and plants, which do not collide, are added where they are surfaces of their own: what is below a ceiling
    is inside, and plants are obstacles to a robot that doesn't know better.
    """
    mesh = Mesh.load(inputs["collision"])
    if not context.has_floor or mesh.classification is None:
        return mesh, None
    ground = group_of()[mesh.classification] == 0
    if not ground.any():
        return mesh, None
    parts = [mesh, *(Mesh.load(inputs[name]).moved_to(mesh.frame) for name in SOFT if name in inputs)]
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + np.int32(n) for part, n in zip(parts, first, strict=False)]
    joined = Mesh(mesh.frame, np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
    return joined, np.pad(ground, (0, len(joined) - len(mesh)))


def _starts(inputs: Inputs, context: NavigationContext, mesh: Mesh) -> F64:
    """Known positions of the robot's sensor in local metres, the start first: its path, and the origin of its map."""
    found = [Trajectory.load(inputs["path"]).positions] if "path" in inputs else []
    if context.T_world_map is not None:
        found.append(np.array(context.T_world_map)[None, :3, 3] - np.asarray(mesh.frame.origin))
    return np.concatenate(found) if found else np.zeros((0, 3))


def _write_points(inputs: Inputs, context: NavigationContext, path: Path) -> int:
    """Write points of the visual surfaces in the frame and unit of the robot's map; returns their number."""
    from scan2sim.pipeline.geometry.surface_distance import sample_surface
    from scan2sim.pipeline.io.navigation import pcd

    names = [f"mesh.{group}" for group in SURFACES]
    meshes = [mesh for mesh in (Mesh.load(inputs[name]) for name in names if name in inputs) if len(mesh)]
    areas = [float(mesh.face_area.sum()) for mesh in meshes]
    spacing = max(context.spacing, float(np.sqrt(sum(areas) / MAX_CLOUD_POINTS)))
    points = [
        sample_surface(mesh, max(1, round(area / spacing**2)), seed)
        for seed, (mesh, area) in enumerate(zip(meshes, areas, strict=True))
    ]
    local = np.concatenate(points)
    intensity = _intensity(inputs, local)
    inverse = np.linalg.inv(np.array(context.T_world_map))
    in_map = (local + np.asarray(meshes[0].frame.origin)) @ inverse[:3, :3].T + inverse[:3, 3]
    far = bool(np.abs(in_map).max() > MAX_FLOAT32_M)
    pcd.write(path, in_map / context.unit, intensity, double=far)
    return len(local)


def _intensity(inputs: Inputs, xyz: F32) -> F32 | None:
    """(N,) intensities 0 to 255 of the nearest points of the cloud, if it has any; the median where none is near."""
    from scipy.spatial import cKDTree

    cloud = PointCloud.load(inputs["cloud"]) if "cloud" in inputs else None
    if cloud is None or cloud.intensity is None or not len(cloud):
        return None
    order = np.lexsort(np.floor(xyz / BLOCK_M).T)
    nearest = np.empty(len(xyz), np.int64)
    nearest[order] = cKDTree(cloud.xyz).query(xyz[order], distance_upper_bound=NEAR_M, workers=-1)[1]
    known: F32 = np.append(cloud.intensity, np.median(cloud.intensity)).astype(np.float32)  # the last: no point is near
    return (known[nearest] / INTENSITY_SCALE).astype(np.float32)


NAVIGATION = Step("navigation", 6, navigation, NavigationParams)
