"""Tracks of road users: a box with poses over time, and their file, `tracks.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame

Category = Literal["car", "van", "truck", "bus", "motorcycle", "cyclist", "pedestrian", "ego"]
FORMAT_VERSION = 1
POSE_FIELDS = ("time", "x", "y", "z", "yaw", "sigma_m", "sigma_rad")
"""Columns of the poses in `tracks.json`."""


@dataclass(frozen=True)
class Track:
    """A road user, as a box of constant size with poses over time.

    Attributes:
        id: unique within the tile.
        category: its class; "ego" is the recording vehicle.
        size: length, width, height in metres.
        times: (T,) seconds on the clock of the sweeps (since the epoch, or since the recording's start), ascending.
        poses: (T, 4) x, y, z of the middle of the box's bottom face in the tile's local coordinates, metres; yaw in
            radians, counter-clockwise from x, the direction of travel.
        sigma: (T, 2) one standard deviation of the position in plan (metres) and of yaw (radians).
        moving: whether it moved while it was recorded; others have the same pose at all times at which they were seen.
        colour: sRGB of its paint or clothes; None if no photo shows it.
    """

    id: int
    category: Category
    size: tuple[float, float, float]
    times: F64
    poses: F64
    sigma: F64
    moving: bool
    colour: tuple[int, int, int] | None

    def at(self, times: npt.ArrayLike) -> F64:
        """Poses (N, 4) at `times` (N,), linearly interpolated, yaw the short way; constant beyond both ends."""
        moments = np.asarray(times, np.float64)
        columns = [*self.poses[:, :3].T, np.unwrap(self.poses[:, 3])]
        return np.stack([np.interp(moments, self.times, column) for column in columns], axis=-1)

    def speeds(self) -> F64:
        """Speed (T,) along the path in m/s, by central differences; 0 for a single pose."""
        if len(self.times) < 2:
            return np.zeros(len(self.times))
        return np.linalg.norm(np.gradient(self.poses[:, :2], self.times, axis=0), axis=1)


def footprint(size: tuple[float, float, float], pose: npt.ArrayLike) -> F64:
    """Corners (4, 2) of a box in plan, counter-clockwise from the front left one, metres.

    Args:
        size: length, width, height.
        pose: (4,) x, y, z, yaw.
    """
    x, y, _, yaw = np.asarray(pose, np.float64)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2 * np.array(size[:2])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([x, y]) + corners @ np.array([[c, s], [-s, c]])


def write_tracks(path: Path, tracks: Sequence[Track], frame: Frame) -> None:
    """Write `tracks.json`, exactly; for GIS there is `pipeline.io.geodata.track_geojson`.

    Args:
        path: the file.
        tracks: tracks in local coordinates of `frame`.
        frame: the tile's frame.
    """
    body = {
        "format": "scan2sim tracks",
        "version": FORMAT_VERSION,
        "frame": asdict(frame),
        "pose_fields": POSE_FIELDS,
        "tracks": [
            {
                "id": track.id,
                "category": track.category,
                "size": track.size,
                "moving": track.moving,
                "colour": track.colour,
                "poses": np.column_stack([track.times, track.poses, track.sigma]).tolist(),
            }
            for track in tracks
        ],
    }
    path.write_text(json.dumps(body), encoding="utf-8")


def read_tracks(path: Path) -> list[Track]:
    """Read what `write_tracks` wrote to `tracks.json`: tracks in local coordinates of `read_frame`.

    Raises:
        InputError: the file doesn't exist or isn't a file of tracks.
    """
    tracks = []
    for entry in _read(path)["tracks"]:
        rows = np.array(entry["poses"], np.float64).reshape(-1, len(POSE_FIELDS))
        length, width, height = entry["size"]
        colour = None if entry["colour"] is None else tuple(entry["colour"])
        tracks.append(
            Track(
                entry["id"], entry["category"], (length, width, height), rows[:, 0].copy(), rows[:, 1:5].copy(),
                rows[:, 5:].copy(), entry["moving"], colour,
            )
        )  # fmt: skip
    return tracks


def read_frame(path: Path) -> Frame:
    """The frame of a `tracks.json`.

    Raises:
        InputError: the file doesn't exist or isn't a file of tracks.
    """
    frame = _read(path)["frame"]
    return Frame(frame["crs"], tuple(frame["origin"]), frame["unit"])


def _read(path: Path) -> dict[str, Any]:
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(path, "file not found", "check the path") from error
    except ValueError as error:
        raise InputError(path, f"not JSON: {error}", "use a tracks.json that the step tracks wrote") from error
    if not isinstance(body, dict) or body.get("version") != FORMAT_VERSION or "tracks" not in body:
        cause = f"not tracks of format version {FORMAT_VERSION}"
        raise InputError(path, cause, "use a tracks.json that this version's step tracks wrote")
    return body
