"""Accuracy of motion classification by frame (part `movement` of `bench.toolboxes`; D3.2, table 9).

Films of level crossings (`data_samples.crossing`: ten views, day and dusk, on a mast swaying in the wind) are processed
by the toolbox. An object counts in a frame if it has been visible for a second, at least half of it and 20 pixels of
its shorter side; it moves if its mean speed over that second is at least `MOVING_SPEED_MIN`. A frame is correct if the
toolbox agrees for the detection that overlaps most; for an object without a detection it is wrong.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.data_samples.crossing_traffic import MOVING_SPEED_MIN
from scan2sim.services.toolboxes import sources
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.iou import iou_matrix
from scan2sim.services.toolboxes.results import Body, Moving
from scan2sim.services.toolboxes.tasks import movement

VIEWS, FRAMES, SEED = 10, 1000, 0
FOLLOWED = ("train", "car", "van", "bus", "truck")
HISTORY_S = 1.0
MIN_VISIBLE_SHARE = 0.5
"""Minimum visible share of an object."""
MIN_SIDE_PX = 20.0
"""Minimum shorter side of an object; smaller ones are ignored."""
MIN_IOU = 0.3
"""Minimum intersection over union of a detection with an object."""
BATCH = 4


@dataclass(frozen=True)
class Prediction:
    """Prediction for an object in a frame: whether it truly moves, and the toolbox's answer (None: none)."""

    view: int
    label: str
    moves: bool
    predicted: bool | None
    found: bool


def rendered(out: Path, views: int = VIEWS, frames: int = FRAMES, seed: int = SEED) -> Path:
    """The films, rendered if missing."""
    folder = out / f"crossings-{views}-{frames}-{seed}"
    if not (folder / "truth.jsonl").exists():
        command = [sys.executable, "-m", "scan2sim.data_samples.crossing", str(folder)]
        subprocess.run([*command, "--views", str(views), "--frames", str(frames), "--seed", str(seed)], check=True)
    return folder


def predictions(folder: Path) -> Iterator[Prediction]:
    """Predictions for all objects in all films."""
    truth: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for line in (folder / "truth.jsonl").open():
        one = json.loads(line)
        truth[one["view"]].append(one)
    model = movement.load(movement.Params())
    for view, frames in sorted(truth.items()):
        yield from _of_film(folder / f"view_{view:02}.mp4", model, view, frames)


def _of_film(film: Path, model: Any, view: int, truth: Sequence[dict[str, Any]]) -> Iterator[Prediction]:
    post_processor = movement.post_processor(movement.Params())
    assert post_processor
    history: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for shot, body, frame in _detected(film, model, truth):
        tracked = post_processor(
            Frame(shot.name, str(film), round(frame["time"] * 1e9), shot.image, lambda _: None), shot.image, body
        )
        for label in frame["objects"]:
            if (
                label["class"] in FOLLOWED
                and label["visible"] >= MIN_VISIBLE_SHARE
                and _side(label["box"]) >= MIN_SIDE_PX
            ):
                past = history[label["track"]]
                past.append((frame["time"], abs(label["speed"])))
                if frame["time"] - past[0][0] >= HISTORY_S:
                    yield _predict(view, label, past, tracked)
            else:
                history.pop(label["track"], None)


def _detected(film: Path, model: Any, truth: Sequence[dict[str, Any]]) -> Iterator[tuple[Any, Body, dict[str, Any]]]:
    """A film's images in batches, with the detections in each, and their truth."""
    batch = []
    for shot, frame in zip(sources.stored_images(film), truth, strict=True):
        batch.append((shot, frame))
        if len(batch) == BATCH or frame is truth[-1]:
            bodies = model([one.image for one, _ in batch])
            for (one, its), body in zip(batch, bodies, strict=True):
                yield one, body, its
            batch = []


def _predict(view: int, label: dict[str, Any], past: list[tuple[float, float]], body: Body) -> Prediction:
    recent = [speed for time, speed in past if past[-1][0] - time <= HISTORY_S]
    detections = body.detections or ()
    shares = iou_matrix([one.box for one in detections], [label["box"]])[:, 0]
    found = bool((shares >= MIN_IOU).any())
    best = detections[int(shares.argmax())] if found else None
    predicted = best.moving if isinstance(best, Moving) else None
    return Prediction(view, label["class"], sum(recent) / len(recent) >= MOVING_SPEED_MIN, predicted, found)


def _side(box: Sequence[float]) -> float:
    return min(box[2] - box[0], box[3] - box[1])


def movement_accuracy(out: Path, views: int = VIEWS, frames: int = FRAMES) -> dict[str, Any]:
    """Shares of correct frames, of moving and of standing objects, and of those that were detected."""
    counts: Counter[tuple[int, str, bool, str]] = Counter()
    for one in predictions(rendered(out, views, frames)):
        outcome = (
            "right"
            if one.predicted == one.moves
            else "unfound"
            if not one.found
            else "unknown"
            if one.predicted is None
            else "wrong"
        )
        counts[one.view, one.label, one.moves, outcome] += 1
    print(
        f"{'view':>4} {'of':<6} {'moves':<6} {'frames':>7} {'right %':>8} {'not found':>9} {'unknown':>8} {'wrong':>6}"
    )
    for view, label, moves in sorted({key[:3] for key in counts}):
        row = Counter({key[3]: count for key, count in counts.items() if key[:3] == (view, label, moves)})
        print(
            f"{view:4d} {label:<6} {moves!s:<6} {row.total():7d} {100 * row['right'] / row.total():8.2f} "
            f"{row['unfound']:9d} {row['unknown']:8d} {row['wrong']:6d}"
        )
    return {
        "moving": _share(counts, True),
        "standing": _share(counts, False),
        "moving_found": _share(counts, True, found=True),
        "standing_found": _share(counts, False, found=True),
        "movement_frames": counts.total(),
    }


def _share(counts: Counter[tuple[int, str, bool, str]], moves: bool, found: bool = False) -> float | None:
    of = Counter[str]()
    for (_, _, state, outcome), count in counts.items():
        if state == moves and not (found and outcome == "unfound"):
            of[outcome] += count
    return round(of["right"] / of.total(), 4) if of else None


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    print(movement_accuracy(Path("bench-out"), *given))
