"""KITTI's tracking boxes of raw drive 0009 (tracking sequence 0001): masks, and surface remaining of cars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.street.world import Photo, World
from scan2sim.pipeline.core.types import F64, Bools

if TYPE_CHECKING:
    from collections.abc import Mapping

MIN_FRAMES = 3
"""Minimum number of frames with a vehicle's box for its position to be reliable."""
MAX_DISTANCE_M = 30.0
"""Maximum distance from the path: cars beyond have few returns and unstable boxes."""
GROUND_M = 0.3
"""Height above a box's bottom below which surface counts as ground: kerbs, and boxes that are a little low."""
SIDE_MARGIN_M = 0.1
"""Margin by which a box is reduced on each side: a wall touching a car isn't part of it."""
SAMPLES_PER_M2 = 400.0
"""Density of surface samples."""


@dataclass(frozen=True)
class Box:
    """A vehicle: `T` (4, 4) from its bottom's centre, x forward, to local metres; `size` (3,) length, width, height."""

    track: int
    T: F64
    size: F64


def mask(labels: Path, frame: int, shape: Sequence[int]) -> Bools:
    """(H, W) pixels within a frame's 2D boxes, including those that KITTI doesn't label (DontCare)."""
    out = np.zeros(tuple(shape[:2]), bool)
    for row in _rows(labels):
        if int(row[0]) == frame:
            left, top, right, bottom = (float(v) for v in row[6:10])
            out[max(0, int(top)) : int(np.ceil(bottom)) + 1, max(0, int(left)) : int(np.ceil(right)) + 1] = True
    return out


def boxes(labels: Path, photos: Mapping[int, Photo]) -> list[Box]:
    """Boxes of the parked vehicles in the world: medians over the frames; moving vehicles are excluded."""
    tracks: dict[int, list[Box]] = {}
    for frame, photo in photos.items():
        for box in in_frame(labels, frame, photo):
            if np.hypot(*(box.T[:2, 3] - photo.T[:2, 3])) < MAX_DISTANCE_M:
                tracks.setdefault(box.track, []).append(box)
    out = []
    for track, drawn in tracks.items():
        samples = np.array([box.T[:3, 3] for box in drawn])
        if len(drawn) < MIN_FRAMES or np.ptp(samples[:, :2], axis=0).max() > 2.5:
            continue
        along, size = (np.median(values, axis=0) for values in ([b.T[:3, 0] for b in drawn], [b.size for b in drawn]))
        out.append(Box(track, _upright(along, np.median(samples, axis=0)), size))
    return out


def in_frame(labels: Path, frame: int, photo: Photo) -> list[Box]:
    """All boxes in a frame, of parked and moving objects."""
    out = []
    for row in _rows(labels):
        if row[2] == "DontCare" or int(row[0]) != frame:
            continue
        height, width, length, x, y, z, ry = (float(v) for v in row[10:17])
        # labels are in the rectified camera 0, photos in camera 2, 6 cm beside it
        centre = photo.T[:3, :3] @ (np.array([x, y, z]) + CAMERA_0) + photo.T[:3, 3]
        along = photo.T[:3, :3] @ np.array([np.cos(ry), 0, -np.sin(ry)])
        out.append(Box(int(row[1]), _upright(along, centre), np.array([length, width, height])))
    return out


def _upright(along: F64, centre: F64) -> F64:
    """Pose (4, 4) of an upright box, from its direction (3,) and the centre of its bottom (3,)."""
    x = along * [1, 1, 0] / np.linalg.norm(along[:2])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 3] = x, [-x[1], x[0], 0], centre
    return T


CAMERA_0 = np.array([0.0597, 0.0, 0.0])
"""Position of camera 0 in camera 2, metres, from P_rect_02 (its fourth column divided by the focal length)."""


def remains(world: World, parked: Sequence[Box]) -> dict[int, float]:
    """Square metres of surface within each vehicle's box, above the ground, by track."""
    samples = sample_surface(world)
    out = {}
    for box in parked:
        local = (samples - box.T[:3, 3]) @ box.T[:3, :3]
        half = box.size[:2] / 2 - SIDE_MARGIN_M
        inside = (np.abs(local[:, :2]) < half).all(axis=1) & (local[:, 2] > GROUND_M) & (local[:, 2] < box.size[2])
        out[box.track] = float(inside.sum() / SAMPLES_PER_M2)
    return out


def corridor(world: World, path: F64) -> float:
    """Square metres of surface where the recording car itself drove, which must be free.

    This is 1 m to each side of the cameras' path, from 1.1 m below them up to their height.
    """
    samples = sample_surface(world)
    out = np.zeros(len(samples), bool)
    for a, b in pairwise(path):
        along = (b - a) * [1, 1, 0]
        length = float(np.linalg.norm(along))
        if length < 0.05:
            continue
        along /= length
        to = samples - a
        ahead, beside = to @ along, to @ [-along[1], along[0], 0]
        out |= (ahead >= 0) & (ahead <= length) & (np.abs(beside) < 1) & (to[:, 2] > -1.1) & (to[:, 2] < 0)
    return float(out.sum() / SAMPLES_PER_M2)


def sample_surface(world: World) -> F64:
    """Samples (N, 3) sample_surface evenly over the world's surface."""
    rng = np.random.default_rng(0)
    corner = world.vertices[world.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    total = np.cumsum(area)
    face = np.searchsorted(total, rng.uniform(0, total[-1], int(total[-1] * SAMPLES_PER_M2))).clip(max=len(area) - 1)
    u, v = np.sqrt(rng.uniform(size=(len(face), 1))), rng.uniform(size=(len(face), 1))
    a, b, c = corner[face].transpose(1, 0, 2)
    return np.asarray((1 - u) * a + u * (1 - v) * b + u * v * c)


def _rows(labels: Path) -> list[list[str]]:
    return [line.split() for line in labels.read_text(encoding="utf-8").splitlines()]
