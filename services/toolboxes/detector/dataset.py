"""Training data of the detector: images with labelled boxes, and their augmentation.

A dataset is a folder with `images/`, `boxes.jsonl` (one line per image: {"image": NAME, "objects": [{"class",
"box": [x0, y0, x1, y1], "visible"}]}, pixels) and `classes.json` (names, in order), as `data_samples.boxes` writes it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation.training.augment import add_shadows, simulate_camera

MIN_VISIBLE_SHARE = 0.25
"""Objects of which a smaller fraction is visible are ignored: neither positive nor negative samples."""
MIN_CROPPED_SHARE = 0.3
"""Objects of whose box a smaller fraction lies within the crop are ignored."""
MIN_OBJECT_PX = 6.0
"""Objects whose longer side is shorter are ignored."""
Rng = np.random.Generator


@dataclass(frozen=True)
class LabelledImage:
    """Image file with its objects: boxes (K, 4) in pixels, classes (K,), visible fractions (K,)."""

    image: Path
    boxes: F32
    classes: F32
    visible: F32


def read(folder: Path) -> tuple[list[LabelledImage], list[str]]:
    """Read the labelled images of a dataset and the names of its classes.

    Raises:
        DataError: the dataset is empty or malformed.
    """
    label_file, remedy = folder / "boxes.jsonl", "Generate a dataset: python -m scan2sim.data_samples.boxes OUT"
    try:
        names = json.loads((folder / "classes.json").read_text(encoding="utf-8"))
        lines = label_file.read_text(encoding="utf-8").splitlines()
        found = [_labelled(folder, json.loads(line), names) for line in lines]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(label_file, f"this file or classes.json can't be read ({error})", remedy) from None
    if not found:
        raise DataError(label_file, "lists no images", remedy)
    return found, names


def _labelled(folder: Path, line: dict[str, object], names: list[str]) -> LabelledImage:
    objects = line["objects"]
    assert isinstance(objects, list)
    boxes = np.array([one["box"] for one in objects], np.float32).reshape(-1, 4)
    classes = np.array([names.index(one["class"]) for one in objects], np.float32)
    visible = np.array([one["visible"] for one in objects], np.float32)
    return LabelledImage(folder / "images" / str(line["image"]), boxes, classes, visible)


def read_image(image: Path) -> U8:
    """Read an image file as (H, W, 3) RGB.

    Raises:
        DataError: the file can't be read.
    """
    import cv2

    bgr = cv2.imread(str(image))
    if bgr is None:
        raise DataError(image, "can't be read as an image", "Generate the dataset again")
    return np.asarray(bgr[..., ::-1], np.uint8)


def augmented_crop(one: LabelledImage, size: tuple[int, int], rng: Rng) -> tuple[F32, F32, F32]:
    """Random crop of an image with augmentation: scale, stretch, mirroring, shadows, camera noise and colour.

    Args:
        size: height and width of the crop.

    Returns:
        (h, w, 3) image in [0, 1]; (K, 5) objects to learn: x0, y0, x1, y1 and class; (I, 4) boxes to ignore.
    """
    import cv2

    rgb = read_image(one.image)
    scale = float(np.exp(rng.uniform(np.log(0.45), np.log(1.7))))
    stretch = float(np.exp(rng.normal(0, 0.1)))
    sx, sy = scale * stretch, scale / stretch
    x = _offset(sx * rgb.shape[1], size[1], rng)
    y = _offset(sy * rgb.shape[0], size[0], rng)
    mirrored = rng.random() < 0.5
    flags = cv2.INTER_LINEAR if scale > 0.7 else cv2.INTER_AREA
    scaled = cv2.resize(rgb, None, fx=sx, fy=sy, interpolation=flags)
    padding = rng.integers(60, 190, 3).tolist()
    shift = np.array([[1, 0, -x], [0, 1, -y]], np.float32)
    out = cv2.warpAffine(scaled, shift, (size[1], size[0]), borderValue=padding)
    boxes = one.boxes * np.array([sx, sy, sx, sy], np.float32) - np.array([x, y, x, y], np.float32)
    if mirrored:
        out = np.ascontiguousarray(out[:, ::-1])
        boxes[:, [0, 2]] = size[1] - boxes[:, [2, 0]]
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    boxes = np.clip(boxes, 0, [size[1], size[0], size[1], size[0]]).astype(np.float32)
    sides = boxes[:, 2:] - boxes[:, :2]
    cropped_share = sides.prod(axis=1) / np.maximum(area, 1e-6)
    inside = (sides > 1).all(axis=1)
    is_visible = (cropped_share > MIN_CROPPED_SHARE) & (one.visible > MIN_VISIBLE_SHARE)
    learn = inside & is_visible & (sides.max(axis=1, initial=0) >= MIN_OBJECT_PX)
    light = np.power(out.astype(np.float32) / 255, np.float32(2.2))
    if rng.random() < 0.35:
        light = add_shadows(light, rng)
    image = simulate_camera(light, rng)
    if rng.random() < 0.1:
        image = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    return image, np.column_stack([boxes, one.classes])[learn].astype(np.float32), boxes[inside & ~learn]


def _offset(available: float, crop: int, rng: Rng) -> int:
    """Random start of a crop along one axis; negative if the image is smaller, which then lies within the crop."""
    return int(rng.uniform(min(0.0, available - crop), max(0.0, available - crop)))
