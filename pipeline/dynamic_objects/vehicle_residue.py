"""What is left of vehicles that were taken out of a world: surface where they stood."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, Mesh
from scan2sim.pipeline.steps.geometry import spread

SIDES = 0.1
"""Metres that a vehicle's box is taken smaller to each side: a wall that it touches is not its own."""
GROUND = 0.3
"""Metres above the ground below which a surface is the ground's: kerbs, and what slopes below a car."""
SAMPLES = 400.0
"""A square metre of surface."""


def left_of_vehicles(meshes: Sequence[Mesh], listed: Path) -> list[float]:
    """Square metres of surface within each vehicle's box, above the ground.

    Args:
        meshes: of the world, in one frame.
        listed: GeoJSON of boxes on the ground in the meshes' CRS, as the step `things` writes it.
    """
    out = []
    for feature in json.loads(listed.read_text(encoding="utf-8"))["features"]:
        about = feature["properties"]
        if about["kind"] == "person" or not meshes:
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
        corners = meshes[0].frame.to_local(np.column_stack([ring, np.full(4, about["ground_z"])])).astype(np.float64)
        out.append(sum(_within(mesh, corners, about["height_m"]) for mesh in meshes))
    return out


def outlines(listed: Path, frame: Frame) -> list[F64]:
    """(4, 2) corners of the boxes of vehicles that stood still, local metres.

    Args:
        listed: as in `left_of_vehicles`.
        frame: that the corners are brought to.
    """
    out = []
    for feature in json.loads(listed.read_text(encoding="utf-8"))["features"]:
        about = feature["properties"]
        if about["kind"] != "person" and not about["moved"]:
            ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
            out.append(frame.to_local(np.column_stack([ring, np.zeros(4)]))[:, :2].astype(np.float64))
    return out


def _within(mesh: Mesh, corners: F64, height: float) -> float:
    """Square metres of a mesh above a rectangle (4, 3), corners in turn, from `GROUND` to `height` over it."""
    low, high = corners.min(axis=0) + [0, 0, GROUND], corners.max(axis=0) + [0, 0, height]
    places = mesh.corners
    near = mesh.keep(((places.max(axis=1) > low) & (places.min(axis=1) < high)).all(axis=1))
    area = float(near.face_area.sum()) if len(near) else 0.0
    if area == 0:
        return 0.0
    found = spread(near, max(1, round(area * SAMPLES)))
    inside = (found[:, 2] > low[2]) & (found[:, 2] < high[2])
    for side in (corners[1] - corners[0], corners[3] - corners[0]):
        inside &= _along(found, corners[0], side)
    return float(inside.mean()) * area


def _along(places: F32, start: F64, side: F64) -> Bools:
    """(N,) whether places lie between the ends of a side, `SIDES` within them."""
    length = float(np.linalg.norm(side[:2]))
    along = (places[:, :2] - start[:2]) @ side[:2] / max(length, 1e-6)
    return np.asarray((along > SIDES) & (along < length - SIDES))
