"""Tracks of road users as GeoJSON, for GIS: the path of each that moves, and a box of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.tracking.tracks import Track, footprint


def write(path: Path, tracks: Sequence[Track], frame: Frame) -> None:
    """Write tracks in the CRS of `frame`, in whose local coordinates they are."""
    geojson.write(path, frame.crs, [feature for track in tracks for feature in _features(track, frame)])


def _features(track: Track, frame: Frame) -> list[geojson.Feature]:
    """The path of a moving track as a line, and its first box as a polygon."""
    speeds = track.speeds()
    properties = {
        "id": track.id,
        "category": track.category,
        "moving": track.moving,
        **{f"{name}_m": round(value, 2) for name, value in zip(("length", "width", "height"), track.size, strict=True)},
        "speed_mps": round(float(np.median(speeds)), 2),
        "sigma_m": round(float(np.median(track.sigma[:, 0])), 3),
        "heading_deg": round(float(np.degrees(track.poses[0, 3])) % 360, 1),
        "colour": None if track.colour is None else "#{:02x}{:02x}{:02x}".format(*track.colour),
    }
    corners = footprint(track.size, track.poses[0])
    ring = frame.to_crs(np.column_stack([corners, np.full(4, track.poses[0, 2])]))
    box: geojson.Feature = ("Polygon", [np.concatenate([ring, ring[:1]]).round(3).tolist()], properties)
    if not track.moving or len(track.times) < 2:
        return [box]
    line = frame.to_crs(track.poses[:, :3]).round(3).tolist()
    return [box, ("LineString", line, properties | {"times": track.times.tolist()})]
