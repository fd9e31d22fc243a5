"""Detectors in ONNX files of other projects: recognized by their inputs and outputs, prepared for and decoded.

A format is recognized once, from the outputs for a grey image; nothing has to be declared. Class names are those of the
file's metadata (`names` or `labels`), of `<name>.labels.txt`, of a `config.json` beside it, or COCO's.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, I32
from scan2sim.segmentation import onnx_session
from scan2sim.services.toolboxes import coco

Array = npt.NDArray[Any]
Outputs = Mapping[str, Array]
"""Outputs of a network by name."""

SUPPORTED = (
    "YOLOv5 to v7 (N, boxes, 5 + classes), YOLOv8 to v12 (N, 4 + classes, boxes), YOLOs with built-in non-maximum "
    "suppression (N, boxes, 6), (boxes, 7) or num_dets, det_boxes, det_scores, det_classes, YOLOX, RT-DETR and D-FINE "
    "(labels, boxes, scores), DETR (logits, pred_boxes), torchvision's detectors (boxes, labels, scores)"
)
REMEDY = f"Export one of: {SUPPORTED}"
STRIDES, ANCHORS = (8, 16, 32), 3
"""Strides of the grids of YOLOs, and YOLOv5's number of boxes per cell."""
MAX_FINAL_BOXES = 1000
"""Most boxes of a network that has suppressed duplicates."""
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
COCO_80 = tuple(coco.LABELS.values())
"""COCO's classes as YOLOs number them."""
COCO_91 = tuple(coco.LABELS.get(i, f"unused {i}") for i in range(91))
"""COCO's classes by their ids, as DETR and torchvision number them."""


@dataclass(frozen=True)
class Candidates:
    """Boxes of an image: corners (K, 4) in pixels of the input, scores and classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


Decode = Callable[[Outputs, int, tuple[int, int]], Candidates]
"""Boxes of an image, from the outputs, the image's index in the batch, and the (height, width) of the input."""


@dataclass(frozen=True)
class Format:
    """How a network takes images, and what its outputs mean.

    Attributes:
        name: name of the format.
        names: names of the classes.
        decode: decoder of the outputs.
        overlapping: whether duplicates have to be suppressed.
        fit: "letterbox": images keep their proportions and are padded; "stretch": they are stretched to the input,
            which is square if its size is dynamic; "scale": the same, but a dynamic input gets their proportions.
        centred: whether the padding is on both sides; otherwise it is right and below.
        scale: brightest value of a pixel in the input.
        bgr: whether channels are blue, green, red.
        mean, std: normalisation of the channels, after the scale.
        batches: whether several images can be processed at once.
        size: longer side of the input in pixels for dynamic inputs.
    """

    name: str
    names: tuple[str, ...]
    decode: Decode
    overlapping: bool = False
    fit: Literal["letterbox", "stretch", "scale"] = "letterbox"
    centred: bool = True
    scale: float = 1.0
    bgr: bool = False
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    batches: bool = True
    size: int = 640

    def normalised(self, rgb: F32) -> F32:
        """Input (3, h, w) from RGB in [0, 1]."""
        channels = (rgb[::-1] if self.bgr else rgb) * np.float32(self.scale)
        mean, std = (np.array(values, np.float32)[:, None, None] for values in (self.mean, self.std))
        return np.ascontiguousarray((channels - mean) / std, np.float32)


def recognize(
    path: Path, inputs: Sequence[str], outputs: Outputs, size: tuple[int, int], metadata: dict[str, str]
) -> Format:
    """Format of a network.

    Args:
        path: its file.
        inputs: names of its inputs.
        outputs: its outputs for a grey image.
        size: height and width of the input.
        metadata: the file's metadata.

    Raises:
        InputError: the format is unknown, or class names are missing.
    """
    names = class_names(path, metadata)
    for known in (_named, _detr, _single):
        found = known(inputs, outputs, size, names, metadata)
        if found is not None:
            if not found.names:
                onnx_session.read_labels(path, metadata)  # raises the error that says where to put them
            return found
    shapes = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in outputs.items())
    known_names = f" and names of {len(names)} classes" if names else ""
    raise InputError(path, f"has outputs that aren't known: {shapes}{known_names}", REMEDY)


def class_names(path: Path, metadata: dict[str, str]) -> tuple[str, ...] | None:
    """Names of the classes: YOLOs write a dictionary as a Python literal into the metadata `names`; None: not given."""
    try:
        names: Any = ast.literal_eval(metadata["names"])
        if isinstance(names, dict):
            names = [names[i] for i in range(len(names))]
        return tuple(map(str, names))
    except (KeyError, ValueError, SyntaxError, TypeError):
        if "labels" in metadata or path.with_suffix(".labels.txt").is_file():
            return onnx_session.read_labels(path, metadata)
        return onnx_session.config_labels(path)


Names = tuple[str, ...] | None


def _named(inputs: Sequence[str], outputs: Outputs, size: tuple[int, int], names: Names, _: object) -> Format | None:
    """Networks whose outputs are final boxes, scores and labels, each in an output of its own."""
    if {"num_dets", "num_detections"} & outputs.keys() and len(outputs) == 4:
        count, corners, confidence, kinds = _matching(
            outputs, ("num_dets", "num_detections"), ("det_boxes", "boxes"), ("det_scores", "scores"),
            ("det_classes", "classes", "labels"),
        )  # fmt: skip
        return Format(
            "YOLO with built-in non-maximum suppression",
            names or COCO_80,
            partial(_counted, count, corners, confidence, kinds),
        )
    boxes = [name for name, one in outputs.items() if one.ndim in (2, 3) and one.shape[-1] == 4]
    if len(boxes) != 1:
        return None
    shape = outputs[boxes[0]].shape[:-1]
    same = {name: one for name, one in outputs.items() if one.shape == shape}
    labels = [name for name, one in same.items() if one.dtype.kind in "iu"]
    scores = [name for name, one in same.items() if one.dtype.kind == "f"]
    if len(labels) != 1 or len(scores) != 1:
        return None
    if len(shape) == 2:
        decode = partial(_final, boxes[0], scores[0], labels[0])
        return Format("RT-DETR or D-FINE", names or COCO_80, decode, fit="stretch")
    decode = partial(_unbatched, boxes[0], scores[0], labels[0])
    return Format("torchvision", names or COCO_91, decode, fit="scale", batches=False, size=1333)


def _matching(outputs: Outputs, *options: Sequence[str]) -> list[str]:
    """Name of the output for each of several lists of names."""
    return [next((name for name in one if name in outputs), one[0]) for one in options]


def _detr(inputs: Sequence[str], outputs: Outputs, size: tuple[int, int], names: Names, _: object) -> Format | None:
    """Transformers with class logits and relative boxes: DETR's softmax has a class for "no object"."""
    logits = [name for name in outputs if name in ("logits", "pred_logits")]
    if len(logits) != 1 or "pred_boxes" not in outputs or outputs["pred_boxes"].ndim != 3:
        return None
    count = outputs[logits[0]].shape[2]
    softmax = count == 92 or (names is not None and count == len(names) + 1)
    if names is None:
        names = {80: COCO_80, 91: COCO_91, 92: COCO_91}.get(count, ())
    if names and len(names) != count - softmax:
        return None
    decode = partial(_relative, logits[0], "pred_boxes", softmax)
    if not softmax and "pixel_mask" not in inputs:
        return Format("RT-DETR or D-FINE", names, decode, fit="stretch")
    return Format("DETR", names, decode, fit="scale", mean=IMAGENET_MEAN, std=IMAGENET_STD, size=1066)


def _single(
    inputs: Sequence[str], outputs: Outputs, size: tuple[int, int], names: Names, metadata: dict[str, str]
) -> Format | None:
    """Networks with one output with a row (YOLOv8 to v12: a column) per box."""
    rows = {name: one for name, one in outputs.items() if one.dtype.kind == "f"}
    name = next(iter(outputs))
    first = outputs[name]
    if (len(rows) > 1 and first.ndim != 3) or first.dtype.kind != "f":
        return None
    if first.ndim == 2 and first.shape[1] == 7 and len(outputs) == 1:
        return Format("YOLO with built-in non-maximum suppression", names or COCO_80, partial(_rows_of_batch, name))
    if first.ndim != 3 or any(one.ndim == 4 for one in outputs.values()):  # masks of a segmentation
        return None
    a, b = first.shape[1:]
    cells = sum((size[0] // s) * (size[1] // s) for s in STRIDES)
    if b == 6 and a <= MAX_FINAL_BOXES and a not in (cells, ANCHORS * cells):
        return Format("YOLO with built-in non-maximum suppression", names or COCO_80, partial(_rows, name))
    if names is None:
        names = COCO_80 if {a, b} & {84, 85} else ()
    classes = len(names)
    if b == 5 + classes or (not names and a > b):
        return _yolo_rows(name, first, names, size, cells, metadata)
    if b == 4 + classes and a != 4 + classes and first[..., :4].max(initial=0) <= 2:
        return Format("RT-DETR of Ultralytics", names, partial(_relative_rows, name), fit="stretch")
    if a == 4 + classes or (not names and b > a):
        return Format("YOLOv8 to v12", names, partial(_columns, name), overlapping=True)
    return None


def _yolo_rows(
    name: str, first: Array, names: tuple[str, ...], size: tuple[int, int], cells: int, metadata: dict[str, str]
) -> Format:
    """YOLOv5 to v7, or YOLOX, which has one box per cell, relative to the cell unless it was exported decoded."""
    decoded = Format("YOLOv5 to v7", names, partial(_objectness_rows, name), overlapping=True)
    if "stride" in metadata or first.shape[1] != cells or (first[..., 4] == 1).all():
        return decoded  # YOLOv6 has one box per cell as well, and an objectness of 1
    form = replace(decoded, name="YOLOX", scale=255.0, bgr=True, centred=False)
    if first[..., :2].max() < max(size) / 2:
        form = replace(form, decode=partial(_grid_rows, name))
    return form


def _best(corners: Array, scores: Array) -> Candidates:
    """Candidates with the best class of each box."""
    labels = scores.argmax(axis=1) if scores.size else np.zeros(len(scores), np.int64)
    best = scores[np.arange(len(scores)), labels] if scores.size else np.zeros(len(scores))
    return Candidates(corners.astype(np.float32), best.astype(np.float32), labels.astype(np.int32))


def corners_of(boxes: Array) -> F32:
    """Corners (K, 4) of boxes with centre, width and height."""
    half = boxes[:, 2:4] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1).astype(np.float32)


def _objectness_rows(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][i]
    return _best(corners_of(rows), rows[:, 4:5] * rows[:, 5:])


def _grid_rows(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][i]
    cells = [np.mgrid[: size[0] // s, : size[1] // s].reshape(2, -1)[::-1].T for s in STRIDES]
    stride = np.concatenate([np.full((len(cell), 1), s) for cell, s in zip(cells, STRIDES, strict=True)])
    boxes = np.concatenate([(rows[:, :2] + np.concatenate(cells)) * stride, np.exp(rows[:, 2:4]) * stride], axis=1)
    return _best(corners_of(boxes), rows[:, 4:5] * rows[:, 5:])


def _columns(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][i].T
    return _best(corners_of(rows), rows[:, 4:])


def _relative_rows(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][i]
    return _best(corners_of(rows) * _scale(size), rows[:, 4:])


def _relative(logits: str, boxes: str, softmax: bool, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    values = outputs[logits][i].astype(np.float64)
    if softmax:
        e = np.exp(values - values.max(axis=1, keepdims=True))
        scores = (e / e.sum(axis=1, keepdims=True))[:, :-1]
    else:
        scores = 1 / (1 + np.exp(-values))
    return _best(corners_of(outputs[boxes][i]) * _scale(size), scores)


def _rows(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][i]
    return _candidates(rows[:, :4], rows[:, 4], rows[:, 5])


def _rows_of_batch(name: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    rows = outputs[name][outputs[name][:, 0] == i]
    return _candidates(rows[:, 1:5], rows[:, 6], rows[:, 5])


def _counted(
    count: str, boxes: str, scores: str, labels: str, outputs: Outputs, i: int, size: tuple[int, int]
) -> Candidates:
    n = int(outputs[count].reshape(-1)[i])
    return _candidates(outputs[boxes][i, :n], outputs[scores][i, :n], outputs[labels][i, :n])


def _final(boxes: str, scores: str, labels: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    return _candidates(outputs[boxes][i], outputs[scores][i], outputs[labels][i])


def _unbatched(boxes: str, scores: str, labels: str, outputs: Outputs, i: int, size: tuple[int, int]) -> Candidates:
    return _candidates(outputs[boxes], outputs[scores], outputs[labels])


def _candidates(corners: Array, scores: Array, labels: Array) -> Candidates:
    return Candidates(corners.astype(np.float32), scores.astype(np.float32), labels.astype(np.int32))


def _scale(size: tuple[int, int]) -> F32:
    height, width = size
    return np.array([width, height, width, height], np.float32)
