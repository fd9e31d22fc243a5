"""Pictures of tracks: boxes over the points in plan, beside the true ones, and boxes over photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from bench.street.boxes import in_frame
from bench.street.world import Photo
from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.classes import CODE, group_of
from scan2sim.pipeline.core.types import F64, PointCloud, View
from scan2sim.pipeline.tracking.scoring_formats import SAME_TIME_S
from scan2sim.pipeline.tracking.tracks import Track, footprint

EVERY = 5
"""Every Nth pose of a moving track is drawn."""
AROUND_M = 50.0
"""Half the width of the plan."""
MOVING_BGR, PARKED_BGR = (0, 255, 0), (0, 160, 255)


def plan(
    path: Path, inputs: Mapping[str, Path], tracks: Sequence[Track], views: Sequence[View], truth: Path | None
) -> None:
    """Write a plan: points of vehicles red, moving boxes blue, parked ones black, KITTI's of the middle frame green."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    cloud, moving = PointCloud.load(inputs["cloud"]), PointCloud.load(inputs["moving"])
    assert cloud.classification is not None
    vehicle = np.isin(cloud.classification, (CODE["vehicle"], CODE["person"]))
    standing = ~vehicle & (group_of()[cloud.classification] > 0)
    figure, axes = plt.subplots(figsize=(16, 12))
    for xyz, colour in ((cloud.xyz[standing][::10], "0.7"), (cloud.xyz[vehicle][::3], "r"), (moving.xyz, "r")):
        axes.scatter(xyz[:, 0], xyz[:, 1], s=0.2, c=colour)
    for track in tracks:
        colour = "g" if track.category == "ego" else "b" if track.moving else "k"
        for pose in track.poses[::EVERY] if track.moving else track.poses[:1]:
            _draw(axes, footprint(track.size, pose), colour)
        axes.text(track.poses[0, 0], track.poses[0, 1], f"{track.id} {track.category}", fontsize=7)
    if truth is not None:
        number = len(views) // 2
        view = views[number]
        photo = Photo(np.zeros((1, 1, 3), np.uint8), np.eye(3), np.asarray(view.T_world_cam), 0.0)
        for box in in_frame(truth, number, photo):
            length, width, height = (float(value) for value in box.size)
            yaw = float(np.arctan2(box.T[1, 0], box.T[0, 0]))
            _draw(axes, footprint((length, width, height), (*box.T[:3, 3], yaw)), "lime")
    middle = tracks[0].poses[:, :2].mean(axis=0)
    axes.set(xlim=middle[0] + [-AROUND_M, AROUND_M], ylim=middle[1] + [-0.75 * AROUND_M, 0.75 * AROUND_M])
    axes.set_aspect("equal")
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _draw(axes: object, corners: F64, colour: str) -> None:
    """A box with a line from its centre to its front."""
    front, centre = corners[[0, 3]].mean(axis=0), corners.mean(axis=0)
    axes.plot(*corners[[0, 1, 2, 3, 0]].T, colour, lw=1)  # type: ignore[attr-defined]
    axes.plot(*np.array([centre, front]).T, colour, lw=0.7)  # type: ignore[attr-defined]


def photos(path: Path, tracks: Sequence[Track], views: Sequence[View]) -> None:
    """Write photos, one below the other, with the boxes of the tracks at their times."""
    rows = []
    for view in views:
        image = cv2.imread(str(view.photo))
        T = np.linalg.inv(view.T_world_cam)
        moment = view.time or 0.0
        for track in tracks:
            there = track.times[0] - SAME_TIME_S <= moment <= track.times[-1] + SAME_TIME_S
            if track.category == "ego" or not there:
                continue
            pose = track.at([moment])[0]
            corners = footprint(track.size, pose)
            low, high = (np.column_stack([corners, np.full(4, pose[2] + dz)]) for dz in (0.0, track.size[2]))
            ends = [(face[k], face[(k + 1) % 4]) for face in (low, high) for k in range(4)]
            for a, b in [*ends, *zip(low, high, strict=True)]:
                line = np.linspace(a, b, 20) @ T[:3, :3].T + T[:3, 3]
                line = line[line[:, 2] > 0.3]
                if len(line) > 1:
                    pixels = np.clip(project(view.camera, line)[0], -5000, 5000).astype(np.int32)
                    cv2.polylines(image, [pixels], False, MOVING_BGR if track.moving else PARKED_BGR, 1)
        rows.append(image)
    cv2.imwrite(str(path), np.vstack(rows))
