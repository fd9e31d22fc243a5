"""Pictures with boxes to learn from, and views of them as other cameras might have taken them.

A folder of `images/`, `boxes.jsonl` (a line an image: {"image": NAME, "things": [{"class", "box": [x0, y0, x1, y1],
"visible"}]}, pixels) and `classes.json` (names, in order), as `data_samples.boxes` writes it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation.training.augment import shaded, taken

HIDDEN = 0.25
"""Share of a thing that must be seen, for it to be learnt; one that is hidden more is neither thing nor none."""
LEFT = 0.3
"""Share of a box that must be left in a view."""
SMALL = 6.0
"""Pixels of the longer side of the smallest things that are learnt."""
Rng = np.random.Generator


@dataclass(frozen=True)
class Labelled:
    """A picture's file, and its things: boxes (K, 4) in pixels, classes (K,), visible shares (K,)."""

    image: Path
    boxes: F32
    classes: F32
    visible: F32


def read(folder: Path) -> tuple[list[Labelled], list[str]]:
    """All pictures of a folder, and the names of the classes.

    Raises:
        DataError: there are none, or a line can't be understood.
    """
    told, remedy = folder / "boxes.jsonl", "Make some: python -m scan2sim.data_samples.boxes OUT"
    try:
        names = json.loads((folder / "classes.json").read_text(encoding="utf-8"))
        lines = told.read_text(encoding="utf-8").splitlines()
        found = [_labelled(folder, json.loads(line), names) for line in lines]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(told, f"and its classes.json can't be read ({error})", remedy) from None
    if not found:
        raise DataError(told, "tells of no pictures", remedy)
    return found, names


def _labelled(folder: Path, line: dict[str, object], names: list[str]) -> Labelled:
    things = line["things"]
    assert isinstance(things, list)
    boxes = np.array([t["box"] for t in things], np.float32).reshape(-1, 4)
    classes = np.array([names.index(t["class"]) for t in things], np.float32)
    visible = np.array([t["visible"] for t in things], np.float32)
    return Labelled(folder / "images" / str(line["image"]), boxes, classes, visible)


def picture(image: Path) -> U8:
    """(H, W, 3) of a file.

    Raises:
        DataError: it can't be read.
    """
    import cv2

    bgr = cv2.imread(str(image))
    if bgr is None:
        raise DataError(image, "can't be read as a picture", "Make it again")
    return np.asarray(bgr[..., ::-1], np.uint8)


def seen(one: Labelled, size: tuple[int, int], rng: Rng) -> tuple[F32, F32, F32]:
    """A part of a picture, enlarged or reduced, mirrored, in other light by another camera.

    Args:
        size: height and width of the part.

    Returns:
        (h, w, 3) in [0, 1]; (K, 5) boxes x0, y0, x1, y1 and class to learn; (I, 4) boxes to be left alone.
    """
    import cv2

    rgb = picture(one.image)
    scale = float(np.exp(rng.uniform(np.log(0.45), np.log(1.7))))
    stretch = float(np.exp(rng.normal(0, 0.1)))
    sx, sy = scale * stretch, scale / stretch
    x = _offset(sx * rgb.shape[1], size[1], rng)
    y = _offset(sy * rgb.shape[0], size[0], rng)
    mirrored = rng.random() < 0.5
    flags = cv2.INTER_LINEAR if scale > 0.7 else cv2.INTER_AREA
    small = cv2.resize(rgb, None, fx=sx, fy=sy, interpolation=flags)
    grey = rng.integers(60, 190, 3).tolist()
    out = cv2.warpAffine(small, np.array([[1, 0, -x], [0, 1, -y]], np.float32), (size[1], size[0]), borderValue=grey)
    boxes = one.boxes * np.array([sx, sy, sx, sy], np.float32) - np.array([x, y, x, y], np.float32)
    if mirrored:
        out = np.ascontiguousarray(out[:, ::-1])
        boxes[:, [0, 2]] = size[1] - boxes[:, [2, 0]]
    whole = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    boxes = np.clip(boxes, 0, [size[1], size[0], size[1], size[0]]).astype(np.float32)
    sides = boxes[:, 2:] - boxes[:, :2]
    left = sides.prod(axis=1) / np.maximum(whole, 1e-6)
    there = (sides > 1).all(axis=1)
    learn = there & (left > LEFT) & (one.visible > HIDDEN) & (sides.max(axis=1, initial=0) >= SMALL)
    light = np.power(out.astype(np.float32) / 255, np.float32(2.2))
    if rng.random() < 0.35:
        light = shaded(light, rng)
    image = taken(light, rng)
    if rng.random() < 0.1:
        image = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    return image, np.column_stack([boxes, one.classes])[learn].astype(np.float32), boxes[there & ~learn]


def _offset(have: float, need: int, rng: Rng) -> int:
    """Where a part of `need` pixels begins; anywhere that shows all there is, if that is less."""
    return int(rng.uniform(min(0.0, have - need), max(0.0, have - need)))
