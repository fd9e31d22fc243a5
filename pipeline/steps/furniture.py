"""Furniture: signs, poles, lamps and trunks as tubes and plates of their own, and where they stand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import I64, Bools, Frame, Mesh, PointCloud
from scan2sim.pipeline.steps.finds import KINDS

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.classify import Thing
    from scan2sim.pipeline.furniture.sign_panels import Plate

    Bools = Bools

AROUND = 4.0  # metres around its middle within which all of a thing's points lie
COLUMNS = ("x", "y", "z", "kind", "height_m", "radius_m", "heading_deg", "shape", "plate_width_m", "plate_height_m")


class FurnitureParams(Params):
    """What is made of street furniture.

    Attributes:
        when: "auto": where the tile has a scanner's path, or photos from the ground; "never": signs, poles and trunks
            stay with the surfaces around them.
        name: of the tile; set by the recipe.
        seed: the tile's (x, y), world metres, where it meets others: what stands beyond its cell is theirs; set by the
            recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    name: str = ""
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def furniture(inputs: Inputs, params: FurnitureParams, out: Path, report: Report) -> Done:
    """Take the `finds` of the tile and of its neighbours, `finds.NAME`, out of the classified `cloud`.

    All of a thing belongs to the tile in whose cell its foot stands; its points are taken out of every tile's surfaces
    alike. What stands in the cell of a neighbour that isn't given is taken out, and shown by nobody.

    Files: `building` and `vegetation`, meshes of signs, poles and lamps, and of trunks, with a class code for every
    face; `taken`, .npz with `index` (N,) of the cloud's points that are a thing's, and which of them are an `own` one's
    (N,); `geojson` and `csv`: places in the tile's CRS, kind, height above the ground, radius, and of plates the way
    that they face (of lamps, that they reach), clockwise from the CRS's north; `plates`, JSON list of all plates, local
    metres; `beside`, JSON list of the places (x, y, z) where the neighbours' poles stand, local metres.
    """
    cloud = PointCloud.load(inputs["cloud"])
    own, others = _parted(inputs, params, cloud.frame)
    report(0.5, "points")
    index, whose = _held(cloud, own, others)
    np.savez(out / "taken.npz", index=index, own=whose)
    files = {"taken": out / "taken.npz"}
    faces = 0
    for group, trunks in (("building", False), ("vegetation", True)):
        mesh = _mesh(cloud.frame, [thing for thing in own if (thing.kind == "trunk") == trunks])
        mesh.save(out / f"{group}.npz")
        files[group] = out / f"{group}.npz"
        faces += len(mesh)
    files |= listed(out, cloud.frame.crs, [_row(thing, cloud.frame) for thing in own])
    lists = {
        "plates": [plate.to_json() for thing in own for plate in thing.plates],
        "beside": [thing.foot.tolist() for thing in others if thing.kind != "trunk"],
    }
    for name, rows in lists.items():
        files[name] = out / f"{name}.json"
        files[name].write_text(json.dumps(rows), encoding="utf-8")
    kinds = {kind: sum(thing.kind == kind for thing in own) for kind in KINDS}
    return Done(files, {**kinds, "points": len(index), "of_neighbours": int((~whose).sum()), "faces": faces})


def _parted(inputs: Inputs, params: FurnitureParams, frame: Frame) -> tuple[list[Thing], list[Thing]]:
    """The tile's own things and its neighbours', local metres."""
    from scan2sim.pipeline.furniture.classify import Thing
    from scan2sim.pipeline.tiling.borders.merge_detections import agreed

    def read(path: Path) -> list[Thing]:
        return [Thing.from_json(row) for row in json.loads(path.read_text(encoding="utf-8"))]

    finds = {params.name: read(inputs["finds"])}
    finds |= {name: read(inputs[f"finds.{name}"]) for name in params.neighbours if f"finds.{name}" in inputs}
    if params.seed is None:
        told = [(params.name, thing) for thing in finds[params.name]]
    else:
        told = agreed(finds, {params.name: params.seed, **params.neighbours})
    here = -np.asarray(frame.origin, np.float64)
    own = [thing.moved(here) for name, thing in told if name == params.name]
    return own, [thing.moved(here) for name, thing in told if name != params.name]


def listed(out: Path, crs: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Path]:
    """Write `furniture.csv` and `furniture.geojson`; each row's `x`, `y` and `z` are in the CRS."""
    from scan2sim.pipeline.io.geodata import geojson

    files = {"csv": out / "furniture.csv", "geojson": out / "furniture.geojson"}
    text = "\n".join([",".join(COLUMNS), *(",".join(str(row.get(c, "")) for c in COLUMNS) for row in rows)])
    files["csv"].write_text(text + "\n", encoding="utf-8")
    features = [((r["x"], r["y"], r["z"]), {k: v for k, v in r.items() if k not in "xyz"}) for r in rows]
    geojson.write_points(files["geojson"], crs, features)
    return files


def _held(cloud: PointCloud, own: Sequence[Thing], others: Sequence[Thing]) -> tuple[I64, Bools]:
    """(N,) indices of the points that are a thing's, ascending, and which of them are an own one's."""
    from scan2sim.pipeline.furniture.classify import eligible
    from scan2sim.pipeline.furniture.poles import Columns

    _, some = eligible(cloud)
    xyz = cloud.xyz[some]
    taken = np.zeros((2, len(some)), bool)
    if len(some) and (own or others):
        columns = Columns(xyz)
        for k, things in enumerate((own, others)):
            for thing in things:
                near = columns.near(thing.stem.middle, AROUND)
                taken[k, near[thing.held(xyz[near])]] = True
    held = taken.any(axis=0)
    return some[held], taken[0, held]


def _mesh(frame: Frame, things: list[Thing]) -> Mesh:
    """All of the things' parts, each face with its class."""
    from scan2sim.pipeline.geometry import primitives

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


FURNITURE = Step("furniture", 4, furniture, FurnitureParams, side_product=True)
