"""Furniture: signs, poles, lamps and trunks as tubes and plates of their own, and where they stand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.cells import Cell
from scan2sim.pipeline.classes import CODE, NOISE, group_of
from scan2sim.pipeline.ranges import Place
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.types import F32, I64, Frame, Mesh, PointCloud, Trajectory

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture import Thing
    from scan2sim.pipeline.plates import Plate
    from scan2sim.pipeline.standing import Columns

CELL = 0.5  # metres, of the ground's heights
BORDER = 4.0  # metres to either side of a border of tiles: what stands there stays with the surfaces, alike in both
LOW, HIGH = 0.2, 14.0  # metres above the ground where things are looked for
COLUMNS = ("x", "y", "z", "kind", "height_m", "radius_m", "heading_deg", "shape", "plate_width_m", "plate_height_m")


class FurnitureParams(Params):
    """What is made of street furniture.

    Attributes:
        when: "auto": where the tile has a scanner's path, or photos from the ground; "never": signs, poles and trunks
            stay with the surfaces around them.
        seed: the tile's (x, y), world metres, where it meets others: what stands beyond its cell is theirs, and what
            stands within 4 m of a border stays with the surfaces in both; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def furniture(inputs: Inputs, params: FurnitureParams, out: Path, report: Report) -> Done:
    """Find what stands upright and thin in the classified `cloud`, seen from the scanner's `path`.

    Files: `building` and `vegetation`, meshes of signs, poles and lamps, and of trunks, with a class code for every
    face; `taken`, .npz with `index` (N,) of the cloud's points that are theirs; `geojson` and `csv`: places in the
    tile's CRS, kind, height above the ground, radius, and of plates the way that they face (of lamps, that they
    reach), clockwise from the CRS's north; `plates`, JSON list of all plates, local metres.
    """
    from scan2sim.pipeline.furniture import find
    from scan2sim.pipeline.standing import Columns

    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    assert cloud.classification is not None
    ground = group_of()[cloud.classification] == 0
    out_of_it = np.isin(cloud.classification, [*NOISE, CODE["vehicle"], CODE["person"]])
    some = np.flatnonzero(~ground & ~out_of_it)
    things: list[Thing] = []
    taken = np.zeros(0, np.int64)
    if ground.any() and len(some):
        height = heights(cloud.xyz[ground], cloud.xyz[some])
        some, height = some[(height > LOW) & (height < HIGH)], height[(height > LOW) & (height < HIGH)]
        part = cloud.take(some)
        report(0.3, "stems")
        if len(part):
            columns = Columns(part.xyz)
            things = find(part, columns, height, path)
    if params.seed is not None and things:
        feet = np.array([thing.foot[:2] for thing in things]) + np.asarray(cloud.frame.origin[:2])
        outside = Cell(params.seed, params.neighbours).outside(feet)
        free = [thing for thing, s in zip(things, outside, strict=True) if abs(s) > BORDER]
        shown = [thing for thing, s in zip(things, outside, strict=True) if s < -BORDER]
        things = [thing for thing, s in zip(things, outside, strict=True) if s <= 0]
    else:
        free = shown = things
    if free:
        taken = some[_held(columns, free)]
    np.savez(out / "taken.npz", index=taken)
    files = {"taken": out / "taken.npz"}
    faces = 0
    for group, trunks in (("building", False), ("vegetation", True)):
        mesh = _mesh(cloud.frame, [thing for thing in shown if (thing.kind == "trunk") == trunks])
        mesh.save(out / f"{group}.npz")
        files[group] = out / f"{group}.npz"
        faces += len(mesh)
    rows = [_row(thing, cloud.frame) for thing in things]
    files |= listed(out, cloud.frame.crs, rows)
    files["plates"] = out / "plates.json"
    plates = [plate.to_json() for thing in shown for plate in thing.plates]
    files["plates"].write_text(json.dumps(plates), encoding="utf-8")
    kinds = {kind: sum(thing.kind == kind for thing in things) for kind in ("pole", "sign", "lamp", "trunk")}
    return Done(files, {**kinds, "points": len(taken), "faces": faces})


def listed(out: Path, crs: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Path]:
    """Write `furniture.csv` and `furniture.geojson`; each row's `x`, `y` and `z` are in the CRS."""
    from scan2sim.pipeline.io import geojson

    files = {"csv": out / "furniture.csv", "geojson": out / "furniture.geojson"}
    text = "\n".join([",".join(COLUMNS), *(",".join(str(row.get(c, "")) for c in COLUMNS) for row in rows)])
    files["csv"].write_text(text + "\n", encoding="utf-8")
    features = [((r["x"], r["y"], r["z"]), {k: v for k, v in r.items() if k not in "xyz"}) for r in rows]
    geojson.write_points(files["geojson"], crs, features)
    return files


def heights(ground: F32, xyz: F32) -> F32:
    """(N,) metres of points (N, 3) above the lowest ground (M, 3) near them."""
    from scipy import ndimage

    from scan2sim.pipeline.heightfield import Raster

    raster = Raster.over(CELL, [ground, xyz])
    low = -raster.highest(np.column_stack([ground[:, :2], -ground[:, 2]]).astype(np.float32))
    nearest = ndimage.distance_transform_edt(np.isnan(low), return_distances=False, return_indices=True)
    smooth = ndimage.median_filter(low[tuple(nearest)], 5)
    return (xyz[:, 2] - smooth[raster.at(xyz)]).astype(np.float32)


def _held(columns: Columns, things: list[Thing]) -> I64:
    """Indices of the points that are one of the things' own."""
    xyz = columns.xyz
    near = [columns.near(thing.stem.middle, 4.0) for thing in things]
    own = [index[thing.held(xyz[index])] for index, thing in zip(near, things, strict=True)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *own]))


def _mesh(frame: Frame, things: list[Thing]) -> Mesh:
    """All of the things' parts, each face with its class."""
    from scan2sim.pipeline import primitives

    parts = [part for thing in things for part in thing.meshes()]
    vertices, faces = primitives.join([triangles for triangles, _ in parts])
    codes = [np.full(len(triangles[1]), code, np.uint8) for triangles, code in parts]
    return Mesh(
        frame, vertices.astype(np.float32), faces, classification=np.concatenate([np.zeros(0, np.uint8), *codes])
    )


def _row(thing: Thing, frame: Frame) -> dict[str, Any]:
    """What the lists tell of a thing."""
    x, y, z = frame.to_crs(thing.foot[None])[0].tolist()
    row: dict[str, Any] = {"x": round(x, 3), "y": round(y, 3), "z": round(z, 3), "kind": thing.kind}
    row |= {"height_m": round(thing.height, 2), "radius_m": round(thing.stem.thickness, 3)}
    if thing.arm is not None:
        row["heading_deg"] = round(float(np.degrees(np.arctan2(*thing.arm.direction))) % 360, 1)
    if thing.plates:
        row |= of_plate(max(thing.plates, key=lambda p: p.width * p.height))
    return row


def of_plate(plate: Plate) -> dict[str, Any]:
    """What the lists tell of a plate."""
    heading = float(np.degrees(np.arctan2(plate.normal[0], plate.normal[1]))) % 360
    size = {"plate_width_m": round(plate.width, 2), "plate_height_m": round(plate.height, 2)}
    return {"heading_deg": round(heading, 1), "shape": plate.shape, **size}


FURNITURE = Step("furniture", 3, furniture, FurnitureParams)
