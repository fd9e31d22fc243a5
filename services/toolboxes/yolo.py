"""Pre- and post-processing of a detector in YOLOv5's exported form: letterboxing, decoding, non-maximum suppression.

The network's input is (B, 3, H, W) float32 RGB in [0, 1], H and W multiples of its stride; its output is (B, N, 5 + C):
centre x and y, width, height in pixels of the input, objectness, and a score per class. The project's own detector has
the same form.
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
    """Letterbox transform from an image to the network's input: scaled, then shifted (pixels right and down).

    Attributes:
        size: (H, W) of the image.
    """

    scale: float
    right: int
    down: int
    size: tuple[int, int]

    def to_image(self, boxes: F32) -> F32:
        """Map corners (K, 4) x0, y0, x1, y1 from pixels of the input to pixels of the image, clipped to it."""
        moved = (boxes - np.array([self.right, self.down] * 2, np.float32)) / np.float32(self.scale)
        height, width = self.size
        return np.clip(moved, 0, [width, height, width, height]).astype(np.float32)


@dataclass(frozen=True)
class Boxes:
    """Detections of an image by descending score: corners (K, 4) x0, y0, x1, y1 in pixels, scores and classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


def letterbox(image: U8, size: int | tuple[int, int], stride: int = 64) -> tuple[F32, Transform]:
    """Scale an image (H, W, 3) into the network's input and pad it with grey.

    Args:
        size: (height, width) of the input, rounded up to the stride; or its longer side only: the shorter one follows
            from the image.

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
    down, right = (padded_h - h) // 2, (padded_w - w) // 2
    out[down : down + h, right : right + w] = scaled
    return out.transpose(2, 0, 1).astype(np.float32) / np.float32(255), Transform(scale, right, down, (height, width))


def decode(output: npt.NDArray[np.floating], transform: Transform, threshold: float = 0.25, iou: float = 0.45) -> Boxes:
    """Decode the network's output (N, 5 + C) of an image, with non-maximum suppression per class.

    Args:
        threshold: minimum score, objectness times class score.
        iou: intersection over union above which the lower score of two boxes of a class is dropped.
    """
    import cv2

    rows = output[output[:, 4] > threshold].astype(np.float32)
    scores = rows[:, 4:5] * rows[:, 5:]
    labels = scores.argmax(axis=1) if len(rows) else np.zeros(0, np.int64)
    best = scores[np.arange(len(rows)), labels]
    order = np.argsort(-best, kind="stable")[:MAX_NMS_CANDIDATES]
    order = order[best[order] > threshold]
    rows, best, labels = rows[order], best[order], labels[order]
    centre, sides = rows[:, :2], rows[:, 2:4]
    corner = np.concatenate([centre - sides / 2, sides], axis=1)
    kept = np.zeros(0, np.intp)
    if len(rows):
        found = cv2.dnn.NMSBoxesBatched(corner.tolist(), best.tolist(), labels.tolist(), threshold, iou)
        kept = np.sort(np.asarray(found, np.intp).ravel())[:MAX_BOXES]
    corner[:, 2:] += corner[:, :2]
    return Boxes(transform.to_image(corner[kept]), best[kept].astype(np.float32), labels[kept].astype(np.int32))
