"""What JPEG and H.264 cost the project's detector: accuracy against the data rate of what is sent.

`python -m bench.toolboxes.quality [--weights FILE.onnx] [--out bench-out/toolbox_quality] [--plot FILE.png]`

Six cameras before level crossings, three of them at dusk (data_samples/crossing.py, 640 x 360, 25 images a second, 60
images each, seeds below those of training), and KITTI raw 0009, frames 0-24, at 10 a second (../shared/data), are
encoded as JPEGs of a quality and as H.264 streams of a bit rate (services/qos/encoding.py), decoded, and every third is
looked at.

- ap50: average precision (VOC 2010) at an overlap of a half, whichever class a thing is taken for; hidden and small
  things count neither way, as in bench/toolboxes/detect.py.
- agreement: F1 of the boxes above a score of .3 against those of the images as they were before.
- kitti_recall: share of KITTI's vehicles from 25 pixels of height that are found with a score of .3.

Mbit/s are of the encoded images alone. Ends with `RESULT {json}`: these by encoding, and as `choice` the lowest data
rate of each kind whose agreement is at most .05 below that of JPEGs of quality 95. KITTI's are null where it isn't
there. Takes three minutes of a core.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.toolboxes.detect import DATA, OWN, SMALL, VEHICLES, Detector, kitti_pictures
from scan2sim.data_samples import crossing
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos import encoding
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.detector.dataset import HIDDEN
from scan2sim.services.toolboxes.detector.metrics import Found, Truth, average_precision, matched
from scan2sim.services.toolboxes.frames import Frame

SEED, VIEWS, IMAGES, EVERY = 300, 6, 60, 3
FIRST = 50
"""Of a view's images: its traffic has come by then."""
KITTI, KITTI_RATE = "kitti_raw0009_f00-24", 10.0
SURE, TALL, LOSS = 0.3, 25.0, 0.05
QUALITIES = (95, 90, 80, 70, 60, 50, 40, 30, 20, 10)
MEGABITS = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)

Encode = Callable[[Sequence[U8], float], tuple[int, list[U8]]]
"""Images in a row and how many come a second, to the bytes of all and to what is decoded of them."""


@dataclass(frozen=True)
class Shown:
    """Images in a row, how many come a second, and what is known of them."""

    images: list[U8]
    rate: float
    truth: list[Truth]

    def watched(self, made: Sequence[U8]) -> list[U8]:
        """Those that the detector looks at."""
        return list(made[::EVERY])


def crossings() -> Iterator[Shown]:
    """One a view."""
    for number in range(VIEWS):
        view = crossing.view(SEED, number, (FIRST + IMAGES) / crossing.FPS)
        shown = [view.frame(index) for index in range(FIRST, FIRST + IMAGES)]
        yield Shown([one.rgb for one in shown], crossing.FPS, [_truth(one.seen) for one in shown])


def _truth(seen: list[Any]) -> Truth:
    corners = np.array([one.box for one in seen], np.float32).reshape(-1, 4)
    visible = np.array([one.visible for one in seen], np.float32)
    sides = (corners[:, 2:] - corners[:, :2]).max(axis=1, initial=0)
    return Truth(corners, np.zeros(len(seen), np.int32), (visible < HIDDEN) | (sides < SMALL))


def kitti() -> list[Shown]:
    """KITTI's vehicles, if it is there."""
    if not (DATA / KITTI).is_dir():
        return []
    images, truth = zip(*kitti_pictures(DATA / KITTI), strict=True)
    tall = [Truth(t.corners, t.labels, t.spared | (t.corners[:, 3] - t.corners[:, 1] < TALL)) for t in truth]
    return [Shown(list(images), KITTI_RATE, tall)]


def encodings() -> dict[str, Encode]:
    """By name."""

    def jpeg(quality: int) -> Encode:
        def encode(images: Sequence[U8], rate: float) -> tuple[int, list[U8]]:
            made = [encoding.jpeg(image, quality) for image in images]
            return sum(map(len, made)), [frames.rgb(Frame("", "", None, one, lambda _: None)) for one in made]

        return encode

    def h264(megabits: float) -> Encode:
        def encode(images: Sequence[U8], rate: float) -> tuple[int, list[U8]]:
            made = list(encoding.stream(images, rate, megabits * 1e6))
            decoded = [_as_large(one, image) for one, image in zip(encoding.pictures(made), images, strict=True)]
            return sum(map(len, made)), decoded

        return encode

    return {
        **{f"jpeg {quality}": jpeg(quality) for quality in QUALITIES},
        **{f"h264 {megabits:g}": h264(megabits) for megabits in MEGABITS},
    }


def _as_large(decoded: U8, image: U8) -> U8:
    """With the odd row or column that a stream has cut off."""
    more = [(0, a - b) for a, b in zip(image.shape, decoded.shape, strict=True)]
    return np.pad(decoded, more, "edge")


def agreement(found: list[Found], plain: list[Found]) -> float:
    """F1 of what is sure against what was sure before."""
    right, total = 0, 0
    for one, before in zip(map(_sure, found), map(_sure, plain), strict=True):
        hit, _ = matched(one, Truth(before.corners, before.labels, np.zeros(len(before.labels), bool)))
        right, total = right + int((hit >= 0).sum()), total + len(one.labels) + len(before.labels)
    return 2 * right / max(1, total)


def _sure(found: Found) -> Found:
    sure = found.scores >= SURE
    return Found(found.corners[sure], found.scores[sure], found.labels[sure])


def accuracy(found: list[Found], truth: list[Truth]) -> float:
    """Average precision of all classes as one."""
    return average_precision([Found(f.corners, f.scores, 0 * f.labels) for f in found], truth, 0)


def recall(found: list[Found], truth: list[Truth], names: list[str]) -> float:
    """Share of KITTI's vehicles that are found, whichever kind of vehicle they are taken for."""
    own = [names.index(name) for name in VEHICLES]
    hits, known = 0, 0
    for one, true in zip(map(_sure, found), truth, strict=True):
        vehicle = np.isin(one.labels, own)
        hit, _ = matched(Found(one.corners[vehicle], one.scores[vehicle], 0 * one.labels[vehicle]), true)
        hits, known = hits + int((hit >= 0).sum()), known + int((~true.spared).sum())
    return hits / max(1, known)


def study(detector: Detector) -> dict[str, dict[str, float | None]]:
    """What each encoding costs, and what there is without one."""
    names = detector.names
    streets, drives = list(crossings()), kitti()

    def looked(parts: list[Shown], encode: Encode | None) -> tuple[float, list[Found]]:
        """Mbit/s, and what is found."""
        megabits, found = [], []
        for part in parts:
            size, made = encode(part.images, part.rate) if encode else (0, part.images)
            megabits.append(8e-6 * size * part.rate / len(part.images))
            found += [detector.find(one, max(one.shape[:2]), 0.01) for one in part.watched(made)]
        return float(np.mean(megabits)) if megabits else float("nan"), found

    known, vehicles = ([t for part in parts for t in part.truth[::EVERY]] for parts in (streets, drives))
    _, plain = looked(streets, None)
    told: dict[str, dict[str, float | None]] = {}
    for name, encode in {"none": None, **encodings()}.items():
        megabits, found = looked(streets, encode)
        kitti_megabits, kitti_found = looked(drives, encode)
        told[name] = {
            "megabits": round(megabits, 3),
            "ap50": round(accuracy(found, known), 4),
            "agreement": round(agreement(found, plain), 4),
            "kitti_megabits": round(kitti_megabits, 3) if drives else None,
            "kitti_recall": round(recall(kitti_found, vehicles, names), 4) if drives else None,
        }
        print(f"{name:10}" + "".join(f"{'-' if v is None else v:>14}" for v in told[name].values()), flush=True)
    return told


def choice(told: dict[str, dict[str, float | None]], kind: str) -> str | None:
    """The encoding of a kind with the lowest data rate, at which and above which little is lost."""
    chosen = None
    for name in (one for one in told if one.startswith(kind)):  # best first
        if (told["jpeg 95"]["agreement"] or 0) - (told[name]["agreement"] or 0) > LOSS:
            break
        chosen = name
    return chosen


def plot(told: dict[str, dict[str, float | None]], file: Path) -> None:
    """Accuracy and agreement over Mbit/s, of the crossings."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for axis, what, title in zip(axes, ("ap50", "agreement"), ("AP50", "agreement with uncompressed"), strict=True):
        for kind, label, colour in (("jpeg", "JPEG, by quality", "#d95f02"), ("h264", "H.264", "#1b7ab8")):
            rows = {name: row for name, row in told.items() if name.startswith(kind)}
            axis.plot([r["megabits"] for r in rows.values()], [r[what] for r in rows.values()], "o-", ms=4,
                      color=colour, label=label)  # fmt: skip
            for name, row in rows.items():
                if kind == "jpeg":
                    axis.annotate(name.split()[1], (row["megabits"], row[what]), fontsize=7, xytext=(3, -9),
                                  textcoords="offset points", color=colour)  # fmt: skip
        axis.set(xscale="log", xlabel="Mbit/s at 640 x 360, 25 images a second", title=title, ylim=(0, None))
        if what == "ap50":
            axis.axhline(told["none"]["ap50"], color="grey", lw=0.8, ls="--", label="uncompressed")
        axis.set_xticks([0.25, 0.5, 1, 2, 4, 8, 16], ["0.25", "0.5", "1", "2", "4", "8", "16"])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(loc="lower right", fontsize=8)
    figure.savefig(file, dpi=100)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=OWN)
    parser.add_argument("--out", type=Path, default=Path("bench-out/toolbox_quality"))
    parser.add_argument("--plot", type=Path, help="default: in OUT")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    print(f"{'':10}" + "".join(f"{name:>14}" for name in ("Mbit/s", "ap50", "agreement", "kitti Mbit/s", "recall")))
    told = study(Detector(given.weights))
    plot(told, given.plot or given.out / "quality.png")
    print("RESULT", json.dumps({"encodings": told, "choice": {kind: choice(told, kind) for kind in ("jpeg", "h264")}}))


if __name__ == "__main__":
    main()
