"""Patch alignment: templates found in images that were warped by a known transform."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, U8
from scan2sim.slam.optical_flow.patch_alignment import SHIFT_MAX_PX, Patches


def texture() -> U8:
    noise = np.random.default_rng(0).normal(0, 1, (240, 240))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


CORNERS = cv2.goodFeaturesToTrack(texture()[20:-20, 20:-20], 30, 0.2, 15)
CENTRES = np.asarray(CORNERS, np.float64).reshape(-1, 2) + (20.3, 19.8)
"""Pixels of features, which aren't at the middle of a pixel."""
IDS = np.arange(len(CENTRES))


def warped(image: U8, A: F64, t: F64) -> U8:
    """The image in which what was at p is at A p + t."""
    return np.asarray(
        cv2.warpAffine(image, np.column_stack([A, t]), (240, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    )


def captured(image: U8) -> Patches:
    patches = Patches()
    patches.capture(IDS, 0, image, CENTRES)
    return patches


@pytest.mark.parametrize(
    ("A", "gain"),
    [(np.eye(2), 1.0), (np.eye(2), 0.6), (np.array([[1.04, 0.02], [-0.02, 0.97]]), 0.8)],
    ids=["shift", "darker", "affine"],
)
def test_position_is_that_of_the_warp(A: F64, gain: float) -> None:
    image, patches = texture(), captured(texture())
    truth = CENTRES @ A.T + (0.4, -0.7)
    new = (gain * warped(image, A, np.array([0.4, -0.7])) + 12).astype(np.uint8)
    tracked = truth + np.random.default_rng(1).uniform(-0.5, 0.5, truth.shape)
    aligned = patches.align(IDS, 0, new, tracked.astype(np.float32))
    error = np.linalg.norm(aligned - truth, axis=1)
    assert np.isnan(error).sum() <= 1  # lost, as the search may start too far away
    assert np.nanmedian(error) < 0.1 and np.nanpercentile(error, 90) < 0.2
    assert np.percentile(np.abs(patches.shape - A), 95) < 0.1


def test_errors_do_not_accumulate_over_frames() -> None:
    image, patches = texture(), captured(texture())
    for k in range(1, 6):
        shift = 0.3 * k
        aligned = patches.align(
            IDS, 0, warped(image, np.eye(2), np.full(2, shift)), (CENTRES + shift).astype(np.float32)
        )
        assert np.abs(aligned - CENTRES - shift).max() < 0.1


def test_other_content_and_far_positions_are_lost() -> None:
    image, patches = texture(), captured(texture())
    assert np.isnan(patches.align(IDS, 0, image[::-1].copy(), CENTRES.astype(np.float32))).all()
    far = patches.align(IDS, 0, image, (CENTRES + 2 * SHIFT_MAX_PX).astype(np.float32))
    assert np.isnan(far).all()
    outside = np.full((len(IDS), 2), -1.0, np.float32)
    assert np.isnan(patches.align(IDS, 0, image, outside)).all()
    assert np.isnan(patches.align(IDS, 0, np.full_like(image, 90), CENTRES.astype(np.float32))).all()


def test_templates_are_kept_by_their_ids() -> None:
    patches = captured(texture())
    patches.keep(IDS[::2])
    rows, known = patches.find(IDS)
    assert known.tolist() == [i % 2 == 0 for i in IDS] and patches.ids[rows[known]].tolist() == IDS[::2].tolist()
