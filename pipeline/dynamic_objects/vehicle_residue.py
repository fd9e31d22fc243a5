"""Vehicle residue: surface that removed vehicles left behind in a world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, Mesh
from scan2sim.pipeline.geometry.surface_distance import sample_surface

BOX_INSET_M = 0.1
"""A vehicle's box is reduced by this on each side: a wall that it touches is not residue."""
GROUND_HEIGHT_M = 0.3
"""Surfaces below this height above the ground belong to the ground: kerbs, slopes below a car."""
SAMPLES_PER_M2 = 400.0


def residue_areas(meshes: Sequence[Mesh], geojson: Path) -> list[float]:
    """Area of the surface inside each vehicle's box, above the ground, m2.

    Args:
        meshes: meshes of the world, in one frame.
        geojson: GeoJSON of boxes on the ground in the meshes' CRS, from the step `instances`.
    """
    out = []
    for feature in json.loads(geojson.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if properties["kind"] == "person" or not meshes:
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
        corners = (
            meshes[0].frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])])).astype(np.float64)
        )
        out.append(sum(_within(mesh, corners, properties["height_m"]) for mesh in meshes))
    return out


def parked_vehicle_outlines(geojson: Path, frame: Frame) -> list[F64]:
    """Corners (4, 2) of the boxes of parked vehicles, local metres.

    Args:
        geojson: as in `residue_areas`.
        frame: frame of the corners.
    """
    out = []
    for feature in json.loads(geojson.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if properties["kind"] != "person" and not properties["moved"]:
            ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
            out.append(frame.to_local(np.column_stack([ring, np.zeros(4)]))[:, :2].astype(np.float64))
    return out


def _within(mesh: Mesh, corners: F64, height: float) -> float:
    """Area in m2 of a mesh above a rectangle (4, 3), from `GROUND_HEIGHT_M` to `height` above it."""
    low, high = corners.min(axis=0) + [0, 0, GROUND_HEIGHT_M], corners.max(axis=0) + [0, 0, height]
    points = mesh.corners
    near = mesh.keep(((points.max(axis=1) > low) & (points.min(axis=1) < high)).all(axis=1))
    area = float(near.face_area.sum()) if len(near) else 0.0
    if area == 0:
        return 0.0
    found = sample_surface(near, max(1, round(area * SAMPLES_PER_M2)))
    inside = (found[:, 2] > low[2]) & (found[:, 2] < high[2])
    for side in (corners[1] - corners[0], corners[3] - corners[0]):
        inside &= _along(found, corners[0], side)
    return float(inside.mean()) * area


def _along(points: F32, start: F64, side: F64) -> Bools:
    """(N,) bool, True for points between the ends of a side, at least `BOX_INSET_M` inside."""
    length = float(np.linalg.norm(side[:2]))
    along = (points[:, :2] - start[:2]) @ side[:2] / max(length, 1e-6)
    return np.asarray((along > BOX_INSET_M) & (along < length - BOX_INSET_M))
