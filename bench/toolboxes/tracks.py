"""Tracks of things through images, against truth (part `tracks` of `bench.toolboxes`): MOTA and IDF1.

KITTI's own boxes of 25 frames, degraded: each is left out one time in ten, its corners are off by 2 pixels, and false
boxes are added; and the boxes of a detector. Figures are motmetrics' (Bernardin and Stiefelhagen, 2008; Ristani et
al., 2016).
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
LEFT_OUT, OFF, FALSE = 0.1, 2.0, 0.5
"""Share of boxes that are left out, pixels that corners are off by (standard deviation), false boxes an image."""
SEEDS = 20
MATCHED = 0.5
"""Intersection over union from which a track's box is a true thing's."""

Truth = Mapping[int, Mapping[int, Sequence[float]]]
"""By frame, and number of the thing: left, top, right, bottom."""


def truth() -> Truth:
    """KITTI's boxes of vehicles."""
    found: dict[int, dict[int, list[float]]] = {frame: {} for frame in range(FRAMES)}
    for line in TRUTH.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[2] in FOLLOWED:
            found[int(words[0])][int(words[1])] = [float(word) for word in words[6:10]]
    return found


def degraded(boxes: Truth, seed: int) -> Callable[[int], list[Detection]]:
    """Detections of a frame, as a detector might find them."""
    rng = np.random.default_rng(seed)

    def found(frame: int) -> list[Detection]:
        here = [
            np.array(box) + rng.normal(scale=OFF, size=4) for box in boxes[frame].values() if rng.random() > LEFT_OUT
        ]
        for _ in range(rng.poisson(FALSE)):
            corner = rng.uniform((0, 100), (1100, 250))
            here.append(np.concatenate([corner, corner + rng.uniform(20, 120, 2)]))
        return [Detection(label="car", score=0.9, box=tuple(box.tolist())) for box in here]

    return found


def scored(boxes: Truth, found: Callable[[int], list[Detection]]) -> tuple[float, float]:
    """MOTA and IDF1 of the tracks of what was found."""
    setattr(np, "asfarray", partial(np.asarray, dtype=np.float64))  # noqa: B010 - of numpy 1, which motmetrics wants
    import motmetrics

    tracker, account = (
        Tracker(sure=movement.Params().threshold, lost=1.0, rate=RATE),
        motmetrics.MOTAccumulator(auto_id=True),
    )
    for frame in sorted(boxes):
        detections = found(frame)
        tracks = tracker.update(detections)
        followed = {track: one.box for track, one in zip(tracks, detections, strict=True) if track is not None}
        distances = motmetrics.distances.iou_matrix(
            _sized(boxes[frame].values()), _sized(followed.values()), max_iou=1 - MATCHED
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
    """MOTA and IDF1, means over seeds; None without the data."""
    if not TRUTH.exists():
        print(f"tracks: left out, there is no {TRUTH}")
        return None
    boxes = truth()
    figures = np.array([scored(boxes, degraded(boxes, seed)) for seed in range(SEEDS)])
    mota, idf1 = figures.mean(axis=0)
    least = figures.min(axis=0)
    print(f"{SEEDS} degraded copies: MOTA {mota:.3f} ({least[0]:.3f} at least), IDF1 {idf1:.3f} ({least[1]:.3f})")
    return {"mota": round(float(mota), 3), "idf1": round(float(idf1), 3)}


if __name__ == "__main__":
    print(tracks())
