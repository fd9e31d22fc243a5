"""Scores of a rendering against a photo: sensitivity, masking, and pooling over photos and parts."""

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.camera.renderer import Image, pinhole
from scan2sim.pipeline.core.types import U8, View
from scan2sim.texturing.evaluate import (
    BAND_EDGES_M,
    BAND_NAMES,
    HeldOut,
    error_image,
    errors,
    figures,
    psnr,
    score,
    tally,
)


@pytest.fixture
def photo() -> U8:
    """(120, 160, 3) photo of soft shapes and fine grain."""
    rng = np.random.default_rng(0)
    soft = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160, 3)).astype(np.float32), (0, 0), 4)
    soft = (soft - soft.mean()) * 8 + 120
    return np.clip(soft + rng.normal(0, 8, soft.shape), 0, 255).astype(np.uint8)


EVERYWHERE = np.ones((120, 160), bool)


def test_photo_compared_with_itself_scores_perfectly(photo: U8) -> None:
    figures = score(photo, photo, EVERYWHERE)
    assert figures["psnr_db"] > 70 and figures["ssim"] == pytest.approx(1) and figures["sharpness"] == 1


def test_gain_compensates_a_darker_rendering(photo: U8) -> None:
    figures = score(photo, (photo * 0.8).astype(np.uint8), EVERYWHERE)
    assert figures["psnr_db"] < 22 and figures["psnr_gain_db"] > 45


def test_sharpness_distinguishes_blurred_from_sharpened(photo: U8) -> None:
    soft = score(photo, cv2.GaussianBlur(photo, (0, 0), 1.5), EVERYWHERE)["sharpness"]
    crisp = np.clip(photo + 1.0 * (photo - cv2.GaussianBlur(photo, (0, 0), 1.5).astype(float)), 0, 255)
    assert soft < 0.5 < 1.2 < score(photo, crisp.astype(np.uint8), EVERYWHERE)["sharpness"]


def test_pixels_outside_the_mask_are_excluded(photo: U8) -> None:
    mask = np.zeros_like(EVERYWHERE)
    mask[30:90, 40:120] = True
    spoiled = np.where(mask[..., None], photo, 255 - photo)
    assert score(photo, spoiled, mask) == pytest.approx(score(photo, photo, mask))


def test_scores_are_nan_without_counted_pixels(photo: U8) -> None:
    assert all(math.isnan(value) for value in score(photo, photo, ~EVERYWHERE).values())
    flat = np.full_like(photo, 90)
    assert math.isnan(score(flat, flat, EVERYWHERE)["sharpness"])


def test_parts_are_pooled_by_pixel_over_photos(photo: U8) -> None:
    """Errors of 10 and 20 grey levels in parts of different sizes, over two photos."""
    photo = np.full_like(photo, 100)
    sums = np.zeros((3, 5))
    for columns in (40, 80):
        part = np.full(EVERYWHERE.shape, -1)
        part[:, :columns], part[:, columns:150] = 0, 1
        render = photo + np.where(part == 0, 10, 20)[..., None].astype(np.uint8)
        sums += tally(errors(photo, render, EVERYWHERE), part, 3)
    first, second, none = (figures(row) for row in sums)
    assert first["psnr_db"] == pytest.approx(psnr(100)) and second["psnr_db"] == pytest.approx(psnr(400))
    assert first["pixels"] == 120 * (40 + 80) and second["pixels"] == 120 * (110 + 70)
    assert none["pixels"] == 0 and math.isnan(none["psnr_db"]) and math.isnan(none["ssim"])


def test_parts_of_one_photo_add_up_to_its_scores(photo: U8) -> None:
    render = cv2.GaussianBlur(photo, (0, 0), 1.0)
    part = np.arange(160)[None] // 40 + 0 * EVERYWHERE
    pooled = figures(tally(errors(photo, render, EVERYWHERE), part, 4).sum(axis=0))
    whole = score(photo, render, EVERYWHERE)
    assert {name: pooled[name] for name in ("psnr_db", "psnr_gain_db", "ssim")} == pytest.approx(
        {name: whole[name] for name in ("psnr_db", "psnr_gain_db", "ssim")}
    )


def test_distance_bands_are_named_by_their_metres() -> None:
    names = [BAND_NAMES[i] for i in np.digitize([4.99, 5.0, 39.0, 41.0], BAND_EDGES_M)]
    assert names == ["0-5 m", "5-10 m", "20-40 m", "40+ m"]


def held(photo: U8, render: U8, mask: npt.NDArray[np.bool_]) -> HeldOut:
    hit = np.ones(mask.shape, bool)
    seen, face, body = (np.zeros(mask.shape, kind) for kind in (np.uint8, np.int32, np.int16))
    shot = Image(render, hit, seen, face, body, *(np.zeros((*mask.shape, *n), np.float32) for n in ((), (2,))))
    view = View("held", pinhole(mask.shape[1], mask.shape[0]), np.eye(4), Path("held.png"))
    return HeldOut(view, photo, shot, mask, errors(photo, render, mask), 1.0, 0.0, 0.0, 0.0, 0.0)


def test_error_image_is_dark_where_equal_bright_where_different_and_grey_where_uncounted(photo: U8) -> None:
    render, mask = photo.copy(), EVERYWHERE.copy()
    render[:60], mask[:, 80:] = np.where(photo[:60] > 127, 0, 255), False
    image = error_image(held(photo, render, mask))
    assert image.shape == (120, 3 * 160 + 8, 3)
    np.testing.assert_array_equal(image[:, :160], photo)
    difference = image[:, -160:].astype(int)
    assert difference[:60, :80].sum(axis=2).mean() > 500 and difference[60:, :80].sum(axis=2).mean() < 20
    assert (difference[:, 80:] == 128).all()


def test_error_image_is_at_most_1600_pixels_wide() -> None:
    large, mask = np.zeros((1000, 2000, 3), np.uint8), np.ones((1000, 2000), bool)
    height, width, _ = error_image(held(large, large, mask)).shape
    assert 1590 < width <= 1600 and height == pytest.approx(width / 3 / 2, abs=2)
