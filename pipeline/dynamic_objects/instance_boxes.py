"""Boxes of detected vehicles and people, and the points in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, Bools, Frame, Mesh

BOX_MARGIN_M = 0.4
"""Margin around a box: mirrors, antennas."""
FACES: I32 = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], *(
        face for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)) for face in ([a, b, b + 4], [a, b + 4, a + 4])
    )], np.int32,
)  # fmt: skip
"""(12, 3) triangles of a box, to the outside: corners 0-3 are around its bottom, counterclockwise, 4-7 above them."""


def is_parked(properties: Mapping[str, Any]) -> bool:
    """Whether an instance with these properties is a vehicle that stood still."""
    return properties["kind"] != "person" and not properties["moved"]


def in_boxes(xyz: F32, frame: Frame, geojson: Path, chosen: Callable[[Mapping[str, Any]], bool]) -> Bools:
    """(N,) bool, True for points in the box of a chosen instance, or within `BOX_MARGIN_M` of it.

    Args:
        xyz: (N, 3) local metres.
        frame: their frame.
        geojson: boxes on the ground in the CRS, from the step `instances`.
        chosen: whether an instance with these properties (`kind`, `moved`, `height_m`, `ground_z`, ...) counts.
    """
    inside = np.zeros(len(xyz), bool)
    for feature in json.loads(geojson.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if not chosen(properties):
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4])
        corners = frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])]))
        offset = xyz - corners.mean(axis=0)
        own = np.abs(offset[:, 2] - properties["height_m"] / 2) < properties["height_m"] / 2 + BOX_MARGIN_M
        for side in (corners[0] - corners[1], corners[1] - corners[2]):
            length = np.linalg.norm(side)
            own &= np.abs(offset @ side) < length * (length / 2 + BOX_MARGIN_M)
        inside |= own
    return inside


def boxes(geojson: Path, frame: Frame, chosen: Callable[[Mapping[str, Any]], bool]) -> Mesh:
    """Boxes of the chosen instances, in local metres; arguments as of `in_boxes`."""
    vertices: list[F32] = [np.zeros((0, 3), np.float32)]
    for feature in json.loads(geojson.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if not chosen(properties):
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
        low = frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])])).astype(np.float32)
        (ax, ay), (bx, by) = low[1, :2] - low[0, :2], low[2, :2] - low[1, :2]
        low = low if ax * by > ay * bx else low[::-1]
        vertices.append(np.concatenate([low, low + np.array([0, 0, properties["height_m"]], np.float32)]))
    corners = np.concatenate(vertices)
    first = np.arange(0, len(corners), 8, dtype=np.int32)
    return Mesh(frame, corners, (first[:, None, None] + FACES).reshape(-1, 3).astype(np.int32))
