"""Object tracking compared with ground truth (part `tracks` of `bench.toolboxes`): MOTA and IDF1.

KITTI's own boxes of 25 frames, degraded: one in ten is dropped, corners have an error of 2 pixels, and false boxes are
added. Metrics are computed by motmetrics (Bernardin and Stiefelhagen, 2008; Ristani et al., 2016).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from bench.paths import ROOT
from scan2sim.pipeline.core.types import F64
from scan2sim.services.toolboxes.results import Detection
from scan2sim.services.toolboxes.tasks import movement
from scan2sim.services.toolboxes.tracking import Tracker

KITTI = ROOT.parent / "shared" / "data" / "kitti_raw0009_f00-24"
TRUTH = KITTI / "tracking_gt_0001_frames_0-24.txt"
FRAMES, RATE = 25, 10.0
FOLLOWED = ("Car", "Van", "Truck")
DROPPED_SHARE, CORNER_ERROR_PX, FALSE_PER_IMAGE = 0.1, 2.0, 0.5
"""Share of dropped boxes, standard deviation of corners, mean number of false boxes per image."""
SEEDS = 20
MIN_IOU = 0.5
"""Minimum intersection over union of a track's box with a true one."""

Truth = Mapping[int, Mapping[int, Sequence[float]]]
"""By frame and number of the object: left, top, right, bottom."""


def truth() -> Truth:
    """KITTI's boxes of vehicles."""
    found: dict[int, dict[int, list[float]]] = {frame: {} for frame in range(FRAMES)}
    for line in TRUTH.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[2] in FOLLOWED:
            found[int(words[0])][int(words[1])] = [float(word) for word in words[6:10]]
    return found


def degraded(boxes: Truth, seed: int) -> Callable[[int], list[Detection]]:
    """Detections by frame, as a detector might find them."""
    rng = np.random.default_rng(seed)

    def found(frame: int) -> list[Detection]:
        here = [
            np.array(box) + rng.normal(scale=CORNER_ERROR_PX, size=4)
            for box in boxes[frame].values()
            if rng.random() > DROPPED_SHARE
        ]
        for _ in range(rng.poisson(FALSE_PER_IMAGE)):
            corner = rng.uniform((0, 100), (1100, 250))
            here.append(np.concatenate([corner, corner + rng.uniform(20, 120, 2)]))
        return [Detection(label="car", score=0.9, box=tuple(box.tolist())) for box in here]

    return found


def score(boxes: Truth, found: Callable[[int], list[Detection]]) -> tuple[float, float]:
    """MOTA and IDF1 of the tracks of detections."""
    setattr(np, "asfarray", partial(np.asarray, dtype=np.float64))  # noqa: B010 - of numpy 1, which motmetrics needs
    import motmetrics

    tracker, account = (
        Tracker(activation_score=movement.Params().threshold, lost_s=1.0, rate=RATE),
        motmetrics.MOTAccumulator(auto_id=True),
    )
    for frame in sorted(boxes):
        detections = found(frame)
        tracks = tracker.update(detections)
        followed = {track: one.box for track, one in zip(tracks, detections, strict=True) if track is not None}
        distances = motmetrics.distances.iou_matrix(
            _sized(boxes[frame].values()), _sized(followed.values()), max_iou=1 - MIN_IOU
        )
        account.update(list(boxes[frame]), list(followed), distances)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        figures = motmetrics.metrics.create().compute(account, metrics=["mota", "idf1"], name="all")
    return float(figures.mota.iloc[0]), float(figures.idf1.iloc[0])


def _sized(boxes: object) -> F64:
    """(N, 4) left, top, width, height."""
    corners = np.array(list(boxes), np.float64).reshape(-1, 4)  # type: ignore[call-overload]
    return np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]])


def tracks() -> dict[str, float] | None:
    """Mean MOTA and IDF1 over seeds; None without the data."""
    if not TRUTH.exists():
        print(f"tracks: skipped, {TRUTH} doesn't exist")
        return None
    boxes = truth()
    figures = np.array([score(boxes, degraded(boxes, seed)) for seed in range(SEEDS)])
    mota, idf1 = figures.mean(axis=0)
    least = figures.min(axis=0)
    print(f"{SEEDS} degraded copies: MOTA {mota:.3f} ({least[0]:.3f} at least), IDF1 {idf1:.3f} ({least[1]:.3f})")
    return {"mota": round(float(mota), 3), "idf1": round(float(idf1), 3)}


if __name__ == "__main__":
    print(tracks())
