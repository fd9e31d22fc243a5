"""Tracks of KITTI raw 0009 compared with the boxes of tracking sequence 0001, by KITTI's protocol.

Cars are scored. Vans are neither required nor false; neither are cars that are hidden for the most part or unclear,
regions that KITTI doesn't label (DontCare), and boxes that are lower than 25 pixels. Cars farther than `MAX_RANGE_M`
are treated in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.scenario.metrics import Frame, clear, hota
from scan2sim.pipeline.core.types import F64, View
from scan2sim.pipeline.tracking.scoring_formats import KITTI_TYPES, Label, labels
from scan2sim.pipeline.tracking.tracks import Track

MAX_RANGE_M = 40.0
MIN_HEIGHT_PX = 25.0
MAX_OCCLUSION = 2
"""KITTI's levels of occlusion: 0 visible, 1 partly, 2 largely hidden, 3 unknown."""
MIN_IOU = 0.5
IGNORED_SHARE = 0.5
"""Share of a box in a region without labels from which it isn't scored."""
CAMERA_0 = np.array([0.0597, 0.0, 0.0])
"""Position of camera 0, in whose axes labels are, in camera 2: P_rect_02's fourth column over the focal length."""


@dataclass(frozen=True)
class Truth:
    """A label of KITTI.

    Attributes:
        track: number of the object.
        kind: its type.
        box: (4,) left, top, right, bottom, pixels.
        truncation, occlusion: KITTI's levels.
        location: (3,) middle of the bottom in the axes of camera 2, metres.
        size: (3,) length, width, height, metres.
        rotation_y: radians.
    """

    track: int
    kind: str
    box: F64
    truncation: int
    occlusion: int
    location: F64
    size: F64
    rotation_y: float


def read_labels(path: Path) -> dict[int, list[Truth]]:
    """Labels of each frame."""
    out: dict[int, list[Truth]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        row = line.split()
        numbers = np.array([float(word) for word in row[6:17]])
        height, width, length = numbers[4:7]
        out.setdefault(int(row[0]), []).append(
            Truth(
                int(row[1]), row[2], numbers[:4], int(row[3]), int(row[4]), numbers[7:10] + CAMERA_0,
                np.array([length, width, height]), float(numbers[10]),
            )
        )  # fmt: skip
    return out


def iou(first: F64, second: F64) -> F64:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4)."""
    both = _intersection(first, second)
    return np.asarray(both / np.maximum(_area(first)[:, None] + _area(second)[None] - both, 1e-9))


def _intersection(first: F64, second: F64) -> F64:
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    return np.asarray(np.clip(high - low, 0, None).prod(axis=2))


def _area(boxes: F64) -> F64:
    return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1))


def _boxes(rows: Sequence[object]) -> F64:
    return np.array(rows, np.float64).reshape(-1, 4)


def scored(truth: Sequence[Truth], found: Sequence[Label]) -> tuple[list[Truth], list[Label]]:
    """The labels and boxes of a frame that count."""
    cars = [one for one in found if KITTI_TYPES[one.track.category] == "Car"]
    objects = [one for one in truth if one.kind in ("Car", "Van")]
    overlap = iou(_boxes([one.box for one in objects]), _boxes([one.image_box for one in cars]))
    rows, columns = linear_sum_assignment(-np.where(overlap >= MIN_IOU, overlap, 0))
    matched = overlap[rows, columns] >= MIN_IOU
    partner = dict(zip(columns[matched].tolist(), rows[matched].tolist(), strict=True))
    unlabelled = _boxes([one.box for one in truth if one.kind == "DontCare"])
    boxes = _boxes([one.image_box for one in cars])
    inside = _intersection(boxes, unlabelled) / np.maximum(_area(boxes), 1e-9)[:, None]
    kept = []
    for k, car in enumerate(cars):
        if k in partner:
            if counts(objects[partner[k]]):
                kept.append(car)
            continue
        low = boxes[k, 3] - boxes[k, 1] <= MIN_HEIGHT_PX
        far = float(np.hypot(car.location[0], car.location[2])) > MAX_RANGE_M
        if not (low or far or inside[k].max(initial=0) > IGNORED_SHARE):
            kept.append(car)
    return [one for one in objects if counts(one)], kept


def counts(one: Truth) -> bool:
    """Whether a label must be found."""
    near = float(np.hypot(one.location[0], one.location[2])) <= MAX_RANGE_M
    return one.kind == "Car" and one.occlusion <= MAX_OCCLUSION and one.truncation == 0 and near


def score(path: Path, tracks: Sequence[Track], views: Sequence[View]) -> dict[str, float]:
    """Metrics; `views`: the photos of frames 0, 1, ..."""
    by_frame = read_labels(path)
    frames, offsets, turns, reversed_ = [], [], [], []
    for number, view in enumerate(views):
        truth, found = scored(by_frame.get(number, []), list(labels(tracks, view)))
        overlap = iou(_boxes([one.box for one in truth]), _boxes([one.image_box for one in found]))
        frames.append(
            Frame(
                np.array([one.track for one in truth], np.int64),
                np.array([one.track.id for one in found], np.int64),
                overlap,
            )
        )
        rows, columns = linear_sum_assignment(-np.where(overlap >= MIN_IOU, overlap, 0))
        for row, column in zip(rows, columns, strict=True):
            if overlap[row, column] < MIN_IOU:
                continue
            true, own = truth[row], found[column]
            offsets.append((true.track, float(np.hypot(*(true.location - own.location)[[0, 2]]))))
            turn = (own.rotation_y - true.rotation_y + np.pi) % (2 * np.pi) - np.pi
            reversed_.append(abs(turn) > np.pi / 2)
            turns.append(abs(turn) if abs(turn) <= np.pi / 2 else np.pi - abs(turn))
    result = clear(frames, MIN_IOU)
    print(f"KITTI 0001: {result.truth} boxes, {result.missed} missed, {result.false} false, {result.switches} switches")
    for track in sorted({track for track, _ in offsets}):
        own_offsets = [metres for one, metres in offsets if one == track]
        print(f"  car {track}: {len(own_offsets)} frames, position {np.median(own_offsets):.2f} m")
    return {
        "mota": result.mota,
        "hota": hota(frames),
        "position_m": float(np.median([metres for _, metres in offsets])) if offsets else float("nan"),
        "yaw_deg": float(np.degrees(np.median(turns))) if turns else float("nan"),
        "reversed": float(np.mean(reversed_)) if reversed_ else float("nan"),
    }
