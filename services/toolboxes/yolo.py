"""Before and after a detector in YOLOv5's exported form: letterboxed pictures in, boxes of pictures out.

A network takes (B, 3, H, W) float32 RGB in [0, 1], H and W multiples of its stride, and gives (B, N, 5 + C): centre x
and y, width, height in its input's pixels, objectness, and a score a class. The project's own detector does the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, I32, U8

GREY = 114
"""Of what fills a letterbox, of 255."""
CANDIDATES = 3000
"""Boxes of highest score that overlap is looked for among."""
MOST = 300
"""Boxes of a picture, at most."""


@dataclass(frozen=True)
class Transform:
    """How a picture lies in a network's input: scaled, then moved (pixels right and down).

    Attributes:
        size: (H, W) of the picture.
    """

    scale: float
    right: int
    down: int
    size: tuple[int, int]

    def back(self, boxes: F32) -> F32:
        """(K, 4) corners x0, y0, x1, y1 in the picture's pixels, within it, of those in the input's."""
        moved = (boxes - np.array([self.right, self.down] * 2, np.float32)) / np.float32(self.scale)
        height, width = self.size
        return np.clip(moved, 0, [width, height, width, height]).astype(np.float32)


@dataclass(frozen=True)
class Boxes:
    """What was found in a picture, best first: corners (K, 4) x0, y0, x1, y1 in its pixels, scores, classes (K,)."""

    corners: F32
    scores: F32
    labels: I32


def letterbox(image: U8, size: int | tuple[int, int], stride: int = 64) -> tuple[F32, Transform]:
    """A picture (H, W, 3), scaled into a network's input, grey around it.

    Args:
        size: (height, width) of the input, rounded up to the stride; or of its longer side alone: the shorter one is as
            long as the picture needs.

    Returns:
        (3, h, w) in [0, 1], and how the picture lies in it.
    """
    import cv2

    height, width = image.shape[:2]
    if isinstance(size, int):
        scale = size / max(height, width)
        size = (round(height * scale), round(width * scale))
    high, wide = (-(-side // stride) * stride for side in size)
    scale = min(size[0] / height, size[1] / width)
    h, w = max(1, round(height * scale)), max(1, round(width * scale))
    flag = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = image if (h, w) == (height, width) else cv2.resize(image, (w, h), interpolation=flag)
    out = np.full((high, wide, 3), GREY, np.uint8)
    down, right = (high - h) // 2, (wide - w) // 2
    out[down : down + h, right : right + w] = small
    return out.transpose(2, 0, 1).astype(np.float32) / np.float32(255), Transform(scale, right, down, (height, width))


def decode(output: npt.NDArray[np.floating], transform: Transform, threshold: float = 0.25, iou: float = 0.45) -> Boxes:
    """The boxes that a network's output (N, 5 + C) of a picture tells of, overlapping ones of a class dropped.

    Args:
        threshold: least score, objectness times the class's.
        iou: overlap from which on the lower score of two of a class is dropped.
    """
    import cv2

    rows = output[output[:, 4] > threshold].astype(np.float32)
    scores = rows[:, 4:5] * rows[:, 5:]
    labels = scores.argmax(axis=1) if len(rows) else np.zeros(0, np.int64)
    best = scores[np.arange(len(rows)), labels]
    order = np.argsort(-best, kind="stable")[:CANDIDATES]
    order = order[best[order] > threshold]
    rows, best, labels = rows[order], best[order], labels[order]
    centre, sides = rows[:, :2], rows[:, 2:4]
    corner = np.concatenate([centre - sides / 2, sides], axis=1)
    kept = np.zeros(0, np.intp)
    if len(rows):
        found = cv2.dnn.NMSBoxesBatched(corner.tolist(), best.tolist(), labels.tolist(), threshold, iou)
        kept = np.sort(np.asarray(found, np.intp).ravel())[:MOST]
    corner[:, 2:] += corner[:, :2]
    return Boxes(transform.back(corner[kept]), best[kept].astype(np.float32), labels[kept].astype(np.int32))
