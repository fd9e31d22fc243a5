"""Formats that tracks are scored in: KITTI's tracking labels (boxes in a camera) and nuScenes' tracking results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, Frame, View
from scan2sim.pipeline.tracking.tracks import Category, Track, footprint

KITTI_TYPES: dict[Category, str] = {
    "car": "Car", "van": "Van", "truck": "Truck", "bus": "Truck", "motorcycle": "Cyclist", "cyclist": "Cyclist",
    "pedestrian": "Pedestrian",
}  # fmt: skip
NUSCENES_NAMES: dict[Category, str] = {
    "car": "car", "van": "car", "truck": "truck", "bus": "bus", "motorcycle": "motorcycle", "cyclist": "bicycle",
    "pedestrian": "pedestrian",
}  # fmt: skip
NEAR_M = 0.1
"""Distance in front of a camera from which points have a pixel."""
SAME_TIME_S = 0.06
"""Time before a track's first and after its last pose in which it is still there: half a sweep."""


class Label(NamedTuple):
    """A box in a photo, in KITTI's terms.

    Attributes:
        track: the track.
        image_box: left, top, right, bottom in pixels, clipped to the photo.
        truncation: share of the box outside the photo.
        location: (3,) middle of its bottom face in camera axes (x right, y down, z forward), metres.
        rotation_y: radians about the camera's y axis.
    """

    track: Track
    image_box: tuple[float, float, float, float]
    truncation: float
    location: F64
    rotation_y: float


def labels(tracks: Sequence[Track], view: View) -> Iterator[Label]:
    """Labels of the tracks in a photo with a time, except of the recording vehicle."""
    from scan2sim.pipeline.camera.models import project

    assert view.time is not None
    T = np.linalg.inv(view.T_world_cam)
    for track in tracks:
        if track.category == "ego" or not track.times[0] - SAME_TIME_S <= view.time <= track.times[-1] + SAME_TIME_S:
            continue
        pose = track.at([view.time])[0]
        corners = footprint(track.size, pose)
        bottom, top = (np.column_stack([corners, np.full(4, pose[2] + dz)]) for dz in (0.0, track.size[2]))
        ends = [(face[k], face[(k + 1) % 4]) for face in (bottom, top) for k in range(4)]
        ends += [(bottom[k], top[k]) for k in range(4)]
        edges = np.concatenate([np.linspace(a, b, 20) for a, b in ends]) @ T[:3, :3].T + T[:3, 3]
        edges = edges[edges[:, 2] > NEAR_M]
        location = T[:3, :3] @ pose[:3] + T[:3, 3]
        if not len(edges) or location[2] < NEAR_M:
            continue
        uv = project(view.camera, edges)[0].astype(np.float64)
        whole_low, whole_high = uv.min(axis=0), uv.max(axis=0)
        size = np.array([view.camera.width - 1, view.camera.height - 1], np.float64)
        low, high = np.clip(whole_low, 0, size), np.clip(whole_high, 0, size)
        if (high - low).min() < 1:
            continue
        share = float(np.prod(high - low) / np.prod(whole_high - whole_low))
        ahead = T[:3, :3] @ np.array([np.cos(pose[3]), np.sin(pose[3]), 0.0])
        box = float(low[0]), float(low[1]), float(high[0]), float(high[1])
        yield Label(track, box, 1 - share, location, float(np.arctan2(-ahead[2], ahead[0])))


def write_kitti(path: Path, tracks: Sequence[Track], views: Sequence[View]) -> None:
    """Write labels in the format of KITTI's tracking benchmark: frames are the photos with times, in their order.

    Args:
        path: the text file.
        tracks: tracks in the coordinates of the views.
        views: photos of one camera.
    """
    lines = []
    timed = sorted((view for view in views if view.time is not None), key=lambda view: view.time or 0.0)
    for frame, view in enumerate(timed):
        for one in labels(tracks, view):
            x, y, z = one.location
            alpha = (one.rotation_y - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
            length, width, height = one.track.size
            numbers = (alpha, *one.image_box, height, width, length, x, y, z, one.rotation_y, 1.0)
            kind = KITTI_TYPES[one.track.category]
            lines.append(
                f"{frame} {one.track.id} {kind} {one.truncation:.2f} 0 " + " ".join(f"{n:.4f}" for n in numbers)
            )
    path.write_text("".join(line + "\n" for line in lines), encoding="utf-8")


def write_nuscenes(path: Path, tracks: Sequence[Track], frame: Frame) -> None:
    """Write tracks as results of nuScenes' tracking task: a sample for each time of the recording vehicle's track.

    Boxes are in the CRS of `frame` in metres, their centre at half their height, rotations are quaternions w, x, y, z.
    Only samples between a track's first and last pose contain it.
    """
    ego = next((track for track in tracks if track.category == "ego"), None)
    moments = np.unique(np.concatenate([np.zeros(0), *(t.times for t in tracks)])) if ego is None else ego.times
    results: dict[str, list[dict[str, object]]] = {f"{moment:.6f}": [] for moment in moments}
    for track in tracks:
        if track.category == "ego":
            continue
        there = (moments >= track.times[0] - SAME_TIME_S) & (moments <= track.times[-1] + SAME_TIME_S)
        speeds = np.interp(moments, track.times, track.speeds()) if track.moving else np.zeros(len(moments))
        length, width, height = track.size
        for moment, speed, pose in zip(moments[there], speeds[there], track.at(moments[there]), strict=True):
            centre = pose[:3] + np.array(frame.origin) + [0, 0, height / 2]
            results[f"{moment:.6f}"].append(
                {
                    "sample_token": f"{moment:.6f}",
                    "translation": centre.tolist(),
                    "size": [width, length, height],
                    "rotation": [float(np.cos(pose[3] / 2)), 0.0, 0.0, float(np.sin(pose[3] / 2))],
                    "velocity": [float(speed * np.cos(pose[3])), float(speed * np.sin(pose[3]))],
                    "tracking_id": str(track.id),
                    "tracking_name": NUSCENES_NAMES[track.category],
                    "tracking_score": float(np.exp(-track.sigma[:, 0].mean())),
                }
            )
    meta = {name: name == "use_lidar" for name in ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")}
    path.write_text(json.dumps({"meta": meta, "results": results}), encoding="utf-8")
