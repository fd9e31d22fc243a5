"""Boxes of detected vehicles and people, and the points in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, Bools, Frame

BOX_MARGIN_M = 0.4
"""Margin around a box: mirrors, antennas."""


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
