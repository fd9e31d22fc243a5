"""Furniture: meshes of signs, poles, lamps and trunks, and the list of their positions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import I64, Bools, Frame, Mesh, PointCloud
from scan2sim.pipeline.furniture.object_lists import sign_panel_columns, write_lists
from scan2sim.pipeline.steps.detect_furniture import KINDS

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.classify import Detection

SEARCH_RADIUS_M = 4.0  # around the middle of a stem; contains all points of the object


class FurnitureParams(Params):
    """Street furniture as separate objects.

    Attributes:
        when: "auto": if the tile has a scanner's path, or photos from the ground; "never": signs, poles and trunks
            are meshed with the surfaces around them.
        context: the tile's cell, if it has neighbours; objects outside it belong to them.
    """

    when: Literal["auto", "never"] = "auto"
    context: TileCell | None = None


def furniture(inputs: Inputs, params: FurnitureParams, out: Path, report: Report) -> Done:
    """Model the `detections` of the tile and of its neighbours (`detections.NAME`); select their points in `cloud`.

    An object belongs to the tile whose cell contains its foot; its points are removed from the surfaces of all tiles.
    If that tile is not given, its points are removed nevertheless, and no tile has a mesh of it.

    Files: `building` (signs, poles and lamps) and `vegetation` (trunks), meshes with a class code per face;
    `furniture_points`, .npz with `index` (N,) of the points of objects, and `own` (N,), True for objects of this tile;
    `geojson` and `csv`: position in the tile's CRS, kind, height above the ground, radius, and heading of sign panels
    (of lamps: of the arm), clockwise from the CRS's north; `sign_panels`, JSON list of all sign panels, local metres;
    `neighbour_poles`, JSON list of the feet (x, y, z) of the neighbours' poles, local metres.
    """
    cloud = PointCloud.load(inputs["cloud"])
    own, others = _load_detections(inputs, params, cloud.frame)
    report(0.5, "points")
    index, whose = _points_of(cloud, own, others)
    np.savez(out / "furniture_points.npz", index=index, own=whose)
    files = {"furniture_points": out / "furniture_points.npz"}
    faces = 0
    for group, trunks in (("building", False), ("vegetation", True)):
        mesh = _mesh(cloud.frame, [detection for detection in own if (detection.kind == "trunk") == trunks])
        mesh.save(out / f"{group}.npz")
        files[group] = out / f"{group}.npz"
        faces += len(mesh)
    files |= write_lists(out, cloud.frame.crs, [_row(detection, cloud.frame) for detection in own])
    lists = {
        "sign_panels": [panel.to_json() for detection in own for panel in detection.panels],
        "neighbour_poles": [detection.foot.tolist() for detection in others if detection.kind != "trunk"],
    }
    for name, rows in lists.items():
        files[name] = out / f"{name}.json"
        files[name].write_text(json.dumps(rows), encoding="utf-8")
    kinds = {kind: sum(detection.kind == kind for detection in own) for kind in KINDS}
    return Done(files, {**kinds, "points": len(index), "neighbour_points": int((~whose).sum()), "faces": faces})


def _load_detections(inputs: Inputs, params: FurnitureParams, frame: Frame) -> tuple[list[Detection], list[Detection]]:
    """The tile's own objects and its neighbours', local metres."""
    from scan2sim.pipeline.furniture.classify import Detection
    from scan2sim.pipeline.tiling.borders.merge_detections import merged_detections

    def read(path: Path) -> list[Detection]:
        return [Detection.from_json(row) for row in json.loads(path.read_text(encoding="utf-8"))]

    here, tile = -np.asarray(frame.origin, np.float64), params.context
    detections = read(inputs["detections"])
    if tile is None:
        return [detection.moved(here) for detection in detections], []
    neighbours = {name: inputs[f"detections.{name}"] for name in tile.neighbours if f"detections.{name}" in inputs}
    found = {tile.name: detections} | {name: read(path) for name, path in neighbours.items()}
    merged = merged_detections(found, {tile.name: tile.seed, **tile.neighbours})
    own = [detection.moved(here) for name, detection in merged if name == tile.name]
    return own, [detection.moved(here) for name, detection in merged if name != tile.name]


def _points_of(cloud: PointCloud, own: Sequence[Detection], others: Sequence[Detection]) -> tuple[I64, Bools]:
    """Indices (N,) of the points of all objects, ascending; and (N,) bool, True for objects of this tile."""
    from scan2sim.pipeline.furniture.classify import eligible
    from scan2sim.pipeline.furniture.poles import Columns

    _, some = eligible(cloud)
    xyz = cloud.xyz[some]
    taken = np.zeros((2, len(some)), bool)
    if len(some) and (own or others):
        columns = Columns(xyz)
        for k, detections in enumerate((own, others)):
            for detection in detections:
                near = columns.near(detection.stem.middle, SEARCH_RADIUS_M)
                taken[k, near[detection.contains(xyz[near])]] = True
    held = taken.any(axis=0)
    return some[held], taken[0, held]


def _mesh(frame: Frame, detections: list[Detection]) -> Mesh:
    """Mesh of all parts of the objects, with a class per face."""
    from scan2sim.pipeline.geometry import primitives

    parts = [part for detection in detections for part in detection.meshes()]
    vertices, faces = primitives.join([triangles for triangles, _ in parts])
    codes = [np.full(len(triangles[1]), code, np.uint8) for triangles, code in parts]
    return Mesh(
        frame, vertices.astype(np.float32), faces, classification=np.concatenate([np.zeros(0, np.uint8), *codes])
    )


def _row(detection: Detection, frame: Frame) -> dict[str, Any]:
    """Row of an object in the CSV and GeoJSON lists."""
    x, y, z = frame.to_crs(detection.foot[None])[0].tolist()
    row: dict[str, Any] = {"x": round(x, 3), "y": round(y, 3), "z": round(z, 3), "kind": detection.kind}
    row |= {"height_m": round(detection.height, 2), "radius_m": round(detection.stem.thickness, 3)}
    if detection.arm is not None:
        row["heading_deg"] = round(float(np.degrees(np.arctan2(*detection.arm.direction))) % 360, 1)
    if detection.panels:
        row |= sign_panel_columns(max(detection.panels, key=lambda p: p.width * p.height))
    return row


FURNITURE = Step("furniture", 6, furniture, FurnitureParams)
