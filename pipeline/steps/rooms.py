"""Surfaces of rooms (step `rooms`): walls as slabs, ceilings as planes, furniture as boxes, from an indoor map.

They replace Poisson reconstruction for the classes building, ceiling and furniture of robots' maps of rooms: the
noise of such maps is as large as the thickness of a wall, and a plain room needs a few hundred triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.buildings.room_lists import Opening
from scan2sim.pipeline.buildings.wall_lines import Run
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I32, Frame, Mesh, PointCloud
from scan2sim.pipeline.geometry.fitted_boxes import Box


class RoomsContext(Context):
    """The surface to make, and the map's point spacing in metres."""

    surface: Literal["building", "ceiling", "furniture"] = "building"
    spacing: float = 0.05


class RoomsParams(Params):
    """Surfaces of rooms.

    Attributes:
        boxes: maximum number of boxes for a piece of furniture, a pillar or another part that is not a wall; large
            groups get up to four more per square metre.
        context: the surface to make.
    """

    boxes: int = Field(16, ge=1, le=1000)
    context: RoomsContext = RoomsContext()


def rooms(inputs: Inputs, params: RoomsParams, out: Path, report: Report) -> Done:
    """Model the points of `cloud` (a part of step `split`); other parts of the map (`other.*`) are its surroundings.

    Walls end at floor and ceiling and meet at corners; doors and windows are rectangular openings. Wall points beside
    the slabs (pillars) become boxes, so that nothing solid is lost.
    Files: `mesh`; of the surface `building` also `list`, GeoJSON of doors, windows, passages and stairs: the middle of
    their lower edge in the tile's CRS, storey, width, height, and heading of the axis through them (of stairs:
    upwards), clockwise from the CRS's north.
    """
    cloud = PointCloud.load(inputs["cloud"])
    others = {name.removeprefix("other."): PointCloud.load(path).xyz for name, path in inputs.items() if "." in name}
    surface = params.context.surface
    metrics: dict[str, Any] = {"points": len(cloud)}
    files = {"mesh": out / "mesh.npz"}
    if surface == "building":
        vertices, faces, openings, found = _walls(cloud.xyz, others, params, report)
        metrics |= found
        openings += _stairs(inputs, params.context.spacing)
        files["list"] = out / "rooms.geojson"
        _write_list(files["list"], cloud.frame, openings)
        metrics["kinds"] = {kind: sum(one.kind == kind for one in openings) for kind in KINDS}
    elif surface == "ceiling":
        vertices, faces = _ceilings(cloud.xyz, others, params.context.spacing)
    else:
        from scan2sim.pipeline.geometry.fitted_boxes import mesh_of

        boxes = _furniture(cloud.xyz, others, params)
        metrics["boxes"] = len(boxes)
        vertices, faces = mesh_of(boxes)
    mesh = Mesh(cloud.frame, vertices, faces)
    mesh.save(files["mesh"])
    return Done(files, metrics | {"faces": len(mesh)})


KINDS = ("door", "passage", "window", "stairs")


def _write_list(path: Path, frame: Frame, openings: Sequence[Opening]) -> None:
    from scan2sim.pipeline.io.geodata import geojson

    features = []
    for one in openings:
        heading = float(np.degrees(np.arctan2(one.axis[0], one.axis[1]))) % (360 if one.kind == "stairs" else 180)
        about = {"kind": one.kind, "storey": one.storey, "heading_deg": round(heading, 1)}
        sizes = {"width_m": one.width, "height_m": one.height, "length_m": one.length}
        position = [round(v, 3) for v in frame.to_crs(one.position[None])[0].tolist()]
        features.append((position, about | {name: round(float(size), 2) for name, size in sizes.items()}))
    geojson.write_points(path, frame.crs, features)


def _stairs(inputs: Inputs, spacing: float) -> list[Opening]:
    """Flights of stairs from the terrain's points of this class."""
    from scan2sim.pipeline.buildings.room_lists import stairs_of
    from scan2sim.pipeline.core.classes import CODE

    if "other.terrain" not in inputs:
        return []
    terrain = PointCloud.load(inputs["other.terrain"])
    if terrain.classification is None:
        return []
    return list(stairs_of(terrain.xyz[terrain.classification == CODE["stairs"]], 0, spacing))


def _walls(
    xyz: F32, others: dict[str, F32], params: RoomsParams, report: Report
) -> tuple[F32, I32, list[Opening], dict[str, Any]]:
    """Slabs of walls, storey by storey, boxes of other wall points, and the openings of the walls."""
    from scan2sim.pipeline.buildings.room_lists import openings_of
    from scan2sim.pipeline.buildings.storeys import find_storeys
    from scan2sim.pipeline.buildings.wall_slabs import Wall, fit_walls, mesh_of
    from scan2sim.pipeline.geometry import fitted_boxes

    spacing = params.context.spacing
    none = np.zeros((0, 3), np.float32)
    terrain, furniture = others.get("terrain", none), others.get("furniture", none)
    storeys = find_storeys(np.concatenate([xyz, *others.values()]), spacing) if len(xyz) else []
    walls: list[Wall] = []
    openings: list[Opening] = []
    covered = np.zeros(len(xyz), bool)
    xy = xyz[:, :2].astype(np.float64)
    for i, storey in enumerate(storeys):
        report(i / len(storeys), f"storey {i + 1} of {len(storeys)}")
        floor, front = (part[(part[:, 2] >= storey.low) & (part[:, 2] < storey.high)] for part in (terrain, furniture))
        own = (xyz[:, 2] >= storey.low) & (xyz[:, 2] < storey.high)
        middle = xyz[own].mean(axis=0, keepdims=True) if own.any() else xyz[:1]
        low = None if storey.floor is None else storey.floor.at(middle)
        high = max(level.at(middle) for level in storey.ceilings) if storey.ceilings else None
        found = fit_walls(xyz[own], floor, front, low, high, spacing)
        walls += found
        openings += openings_of(found, i)
        for wall in found:
            inside = wall.run.contains(xy, COVERED_M) & (xyz[:, 2] > wall.low - COVERED_M)
            covered |= inside & (xyz[:, 2] < wall.high + COVERED_M)
    report(0.9, "pillars")
    boxes = fitted_boxes.fit_boxes(xyz[~covered], spacing, params.boxes)
    slab_vertices, slab_faces = mesh_of(walls)
    box_vertices, box_faces = fitted_boxes.mesh_of(boxes)
    metrics = {
        "walls": len(walls),
        "two_sided": sum(wall.sides == 2 for wall in walls),
        "openings": sum(len(wall.openings) for wall in walls),
        "boxes": len(boxes),
        "in_walls": round(float(covered.mean()), 4) if len(xyz) else 0.0,
    }
    return (
        np.concatenate([slab_vertices, box_vertices]),
        np.concatenate([slab_faces, box_faces + np.int32(len(slab_vertices))]).astype(np.int32),
        openings,
        metrics,
    )


def _furniture(xyz: F32, others: dict[str, F32], params: RoomsParams) -> list[Box]:
    """Boxes of furniture, storey by storey; none crosses a wall or the opening of a door."""
    from scan2sim.pipeline.buildings.storeys import find_storeys
    from scan2sim.pipeline.buildings.wall_lines import wall_noise
    from scan2sim.pipeline.buildings.wall_slabs import wall_runs
    from scan2sim.pipeline.geometry.fitted_boxes import Surroundings, fit_boxes

    spacing = params.context.spacing
    none = np.zeros((0, 3), np.float32)
    boxes: list[Box] = []
    for storey in find_storeys(np.concatenate([xyz, *others.values()]), spacing) if len(xyz) else []:
        own, walls, floor = (
            part[(part[:, 2] >= storey.low) & (part[:, 2] < storey.high)]
            for part in (xyz, others.get("building", none), others.get("terrain", none))
        )
        if not len(own):
            continue
        runs = wall_runs(walls, spacing)
        bottom = None if storey.floor is None else storey.floor.at(own.mean(axis=0, keepdims=True))
        for run in runs:
            own = own[~run.contains(own)]
        around = Surroundings(floor, bottom, _heading(runs), wall_noise(runs) / NOISE_QUANTILE)
        boxes += [_to_walls(box, runs, around.noise, bottom) for box in fit_boxes(own, spacing, params.boxes, around)]
    return boxes


def _to_walls(box: Box, runs: Sequence[Run], noise: float, bottom: float | None) -> Box:
    """The box, extended to walls that are so near that nothing fits between: noise and shadows leave a gap there."""
    if bottom is None or box.low[2] > bottom:
        return box
    low, high = box.low.copy(), box.high.copy()
    c, s = np.cos(box.heading), np.sin(box.heading)
    turn = np.array([[c, -s], [s, c]])
    middle = turn @ ((low + high) / 2)[:2]
    for run in runs:
        cos = turn.T @ run.normal
        axis = int(np.abs(cos).argmax())
        if abs(cos[axis]) < PARALLEL_COS or not run.start < float(run.along @ middle) < run.end:
            continue
        face = max(run.half - NOISE_QUANTILE * noise, 0.0)
        wall = (low + high)[axis] / 2 + float(run.offset - run.normal @ middle) / cos[axis]
        if 0 < low[axis] - (wall + face) < WALL_GAP_M:
            low[axis] = wall + face
        elif 0 < (wall - face) - high[axis] < WALL_GAP_M:
            high[axis] = wall - face
    return Box(box.heading, low, high)


PARALLEL_COS = 0.985
"""Cosine of the largest angle between a wall and the side of a box that extends to it."""
WALL_GAP_M = 0.25


def _heading(runs: Sequence[Run]) -> float:
    """Heading of the longest wall's normal, radians."""
    if not runs:
        return 0.0
    normal = max(runs, key=lambda run: run.length).normal
    return float(np.arctan2(normal[1], normal[0]))


NOISE_QUANTILE = 2.05
"""Standard deviations in half of the extent of a wall's points, from their 2nd to their 98th percentile."""
COVERED_M = 0.2
"""Distance from a wall's slab within which points belong to it."""


def _ceilings(xyz: F32, others: dict[str, F32], spacing: float) -> tuple[F32, I32]:
    """Ceilings of all storeys."""
    from scan2sim.pipeline.buildings.ceilings import ceiling_mesh
    from scan2sim.pipeline.buildings.storeys import find_storeys

    vertices, faces, count = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int32)], 0
    everything = np.concatenate([xyz, *others.values()])
    for storey in find_storeys(everything, spacing) if len(xyz) else []:
        own, all_points = (part[(part[:, 2] >= storey.low) & (part[:, 2] < storey.high)] for part in (xyz, everything))
        v, f = ceiling_mesh(own, all_points, storey.ceilings, spacing)
        vertices.append(v)
        faces.append(f + np.int32(count))
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


ROOMS = Step("rooms", 3, rooms, RoomsParams, per_class=True)
