"""Pre- and post-processing of detectors: letterboxing, decoding of YOLOv5's form, non-maximum suppression.

In YOLOv5's exported form, which is that of the project's own detector, the input is (B, 3, H, W) float32 RGB in [0, 1],
H and W multiples of its stride; the output is (B, N, 5 + C): centre x and y, width, height in pixels of the input,
objectness, and a score per class. Other forms: `detector_formats`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, I32, U8

PADDING_GREY = 114
"""Grey level of the padding, 0 to 255."""
MAX_NMS_CANDIDATES = 3000
"""Boxes of highest score that enter the non-maximum suppression."""
MAX_BOXES = 300
"""Boxes per image."""


@dataclass(frozen=True)
class Transform:
    """Transform from an image to the network's input: scaled, then shifted (pixels right and down).

    Attributes:
        scale: horizontal scale.
        size: (H, W) of the image.
        scale_y: vertical scale; None: as the horizontal one.
    """

    scale: float
    right: int
    down: int
    size: tuple[int, int]
    scale_y: float | None = None

    def to_image(self, boxes: F32) -> F32:
        """Map corners (K, 4) x0, y0, x1, y1 from pixels of the input to pixels of the image, clipped to it."""
        scales = np.array([self.scale, self.scale_y or self.scale] * 2, np.float32)
        moved = (boxes - np.array([self.right, self.down] * 2, np.float32)) / scales
        height, width = self.size
        return np.clip(moved, 0, [width, height, width, height]).astype(np.float32)


@dataclass(frozen=True)
class Boxes:
    """Detections of an image by descending score: corners (K, 4) x0, y0, x1, y1 in pixels, scores and classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


def letterbox(
    image: U8, size: int | tuple[int, int], stride: int = 64, *, centred: bool = True
) -> tuple[F32, Transform]:
    """Scale an image (H, W, 3) into the network's input and pad it with grey.

    Args:
        image: RGB.
        size: (height, width) of the input, rounded up to the stride; or its longer side only: the shorter one follows
            from the image.
        stride: number of pixels of which the input's sides are multiples.
        centred: pad on both sides; otherwise right and below.

    Returns:
        Input (3, h, w) in [0, 1], and its transform.
    """
    import cv2

    height, width = image.shape[:2]
    if isinstance(size, int):
        scale = size / max(height, width)
        size = (round(height * scale), round(width * scale))
    padded_h, padded_w = (-(-side // stride) * stride for side in size)
    scale = min(size[0] / height, size[1] / width)
    h, w = max(1, round(height * scale)), max(1, round(width * scale))
    flag = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    scaled = image if (h, w) == (height, width) else cv2.resize(image, (w, h), interpolation=flag)
    out = np.full((padded_h, padded_w, 3), PADDING_GREY, np.uint8)
    down, right = ((padded_h - h) // 2, (padded_w - w) // 2) if centred else (0, 0)
    out[down : down + h, right : right + w] = scaled
    return out.transpose(2, 0, 1).astype(np.float32) / np.float32(255), Transform(scale, right, down, (height, width))


def stretch(image: U8, size: tuple[int, int]) -> tuple[F32, Transform]:
    """Scale an image (H, W, 3) to the (height, width) of the network's input, whatever its proportions.

    Returns:
        Input (3, h, w) in [0, 1], and its transform.
    """
    import cv2

    (height, width), (h, w) = image.shape[:2], size
    flag = cv2.INTER_AREA if h < height else cv2.INTER_LINEAR
    scaled = image if (h, w) == (height, width) else cv2.resize(image, (w, h), interpolation=flag)
    transform = Transform(w / width, 0, 0, (height, width), h / height)
    return scaled.transpose(2, 0, 1).astype(np.float32) / np.float32(255), transform


def decode(
    output: npt.NDArray[np.floating], transform: Transform, threshold: float | F32 = 0.25, iou: float = 0.45
) -> Boxes:
    """Decode the network's output (N, 5 + C) of an image, with non-maximum suppression per class.

    Args:
        output: rows of YOLOv5's form.
        transform: of the image.
        threshold: minimum score, objectness times class score; of all classes or (C,) of each.
        iou: intersection over union above which the lower score of two boxes of a class is dropped.
    """
    rows = output[output[:, 4] > np.min(threshold)].astype(np.float32)
    scores = rows[:, 4:5] * rows[:, 5:]
    labels = scores.argmax(axis=1).astype(np.int32) if len(rows) else np.zeros(0, np.int32)
    half = rows[:, 2:4] / 2
    corners = np.concatenate([rows[:, :2] - half, rows[:, :2] + half], axis=1)
    return select(corners, scores[np.arange(len(rows)), labels], labels, transform, threshold, iou)


def select(
    corners: F32, scores: F32, labels: I32, transform: Transform, threshold: float | F32, iou: float | None
) -> Boxes:
    """Boxes with a sufficient score, in pixels of the image, by descending score.

    Args:
        corners: (K, 4) in pixels of the input.
        scores: (K,) scores.
        labels: (K,) classes.
        transform: of the image.
        threshold: minimum score; of all classes or (C,) of each.
        iou: non-maximum suppression: intersection over union above which the lower score of two boxes of a class is
            dropped; None: no suppression.
    """
    import cv2

    least = threshold if isinstance(threshold, float) else threshold[labels]
    order = np.argsort(-scores, kind="stable")[:MAX_NMS_CANDIDATES]
    order = order[(scores > least)[order]]
    corners, scores, labels = corners[order], scores[order], labels[order]
    kept = np.arange(len(order))[:MAX_BOXES]
    if iou is not None and len(order):
        sized = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
        found = cv2.dnn.NMSBoxesBatched(sized.tolist(), scores.tolist(), labels.tolist(), 0.0, iou)
        kept = np.sort(np.asarray(found, np.intp).ravel())[:MAX_BOXES]
    return Boxes(transform.to_image(corners[kept]), scores[kept].astype(np.float32), labels[kept].astype(np.int32))
