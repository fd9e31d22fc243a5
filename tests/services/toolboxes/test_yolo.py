"""Pre- and post-processing of detectors: letterboxing and its inverse, non-maximum suppression."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32
from scan2sim.services.toolboxes.iou import iou_matrix
from scan2sim.services.toolboxes.yolo import PADDING_GREY, Transform, decode, letterbox


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ((360, 640), 640), ((375, 1242), 640), ((1080, 1920), (384, 640)), ((640, 360), 640), ((90, 70), (256, 384)),
        ((3, 900), 320),
    ],
)  # fmt: skip
def test_boxes_are_mapped_back_to_the_image(shape: tuple[int, int], size: int | tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    rgb = np.full((*shape, 3), 30, np.uint8)
    x, y = int(0.7 * shape[1]), int(0.4 * shape[0])
    w, h = max(4, shape[1] // 8), max(1, shape[0] // 8)
    rgb[y : y + h, x : x + w] = rng.integers(200, 255, 3)
    image, transform = letterbox(rgb, size)
    assert image.dtype == np.float32 and image.shape[1] % 64 == 0 and image.shape[2] % 64 == 0
    bright = np.argwhere(image.min(axis=0) > 0.6)
    if transform.scale * min(w, h) < 2:
        return
    low, high = bright.min(axis=0), bright.max(axis=0) + 1
    back = transform.to_image(np.array([[low[1], low[0], high[1], high[0]]], np.float32))[0]
    np.testing.assert_allclose(back, [x, y, x + w, y + h], atol=1.0 / transform.scale + 0.6)
    outside = transform.to_image(np.array([[-50, -50, 5000, 5000]], np.float32))[0]
    np.testing.assert_array_equal(outside, [0, 0, shape[1], shape[0]])


def test_letterbox_is_padded_with_grey() -> None:
    image, transform = letterbox(np.zeros((100, 400, 3), np.uint8), (256, 384))
    assert transform.down == 80 and transform.right == 0
    np.testing.assert_allclose(image[:, :80], PADDING_GREY / 255)
    assert image[:, 80:176].max() == 0


def reference_nms(rows: F32, threshold: float, iou: float) -> list[tuple[int, int]]:
    """(row, class) of the boxes kept by a naive non-maximum suppression, by descending score."""
    every = [(float(r[4] * r[5:].max()), int(r[5:].argmax()), i) for i, r in enumerate(rows)]
    kept: list[tuple[int, int]] = []
    for score, label, i in sorted(every, key=lambda one: -one[0]):
        box = np.array([[*(rows[i, :2] - rows[i, 2:4] / 2), *(rows[i, :2] + rows[i, 2:4] / 2)]], np.float32)
        others = [np.array([[*(rows[k, :2] - rows[k, 2:4] / 2), *(rows[k, :2] + rows[k, 2:4] / 2)]], np.float32)
                  for k, other in kept if other == label]  # fmt: skip
        if score > threshold and all(iou_matrix(box, other)[0, 0] <= iou for other in others):
            kept.append((i, label))
    return kept


@pytest.mark.parametrize("seed", range(8))
def test_non_maximum_suppression_matches_a_naive_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres = rng.uniform(40, 300, (12, 2))
    around = centres[rng.integers(12, size=150)] + rng.normal(0, 6, (150, 2))
    rows = np.concatenate([around, rng.uniform(20, 60, (150, 2)), rng.random((150, 4))], axis=1).astype(np.float32)
    got = decode(rows, Transform(1.0, 0, 0, (400, 400)), 0.2, 0.45)
    want = reference_nms(rows, 0.2, 0.45)
    assert got.labels.tolist() == [label for _, label in want] and len(want) > 10
    np.testing.assert_allclose(got.scores, [rows[i, 4] * rows[i, 5:].max() for i, _ in want], rtol=1e-5)
    corners = [[*(rows[i, :2] - rows[i, 2:4] / 2), *(rows[i, :2] + rows[i, 2:4] / 2)] for i, _ in want]
    np.testing.assert_allclose(got.corners, np.clip(corners, 0, 400), atol=1e-3)


def test_no_detections_give_empty_boxes() -> None:
    got = decode(np.zeros((100, 12), np.float32), Transform(0.5, 3, 4, (100, 100)))
    assert got.corners.shape == (0, 4) and got.scores.shape == (0,) and got.labels.shape == (0,)
