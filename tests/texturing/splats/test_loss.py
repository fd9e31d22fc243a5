"""The photometric loss is that of the literature, and its derivative that of its value."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, U8, Bools
from scan2sim.texturing.splats import loss
from scan2sim.texturing.splats.exposure import Response, falloff

SHAPE = (24, 30)
PLAIN = Response.of(np.zeros(5), falloff(0, 0, *SHAPE))
EXPOSED = Response.of(np.array([0.2, 0.1, 0.15, 0, 0]), falloff(0.3, 0.1, *SHAPE))
"""A photo that is darker than the world, with dark corners."""


def pair(seed: int, noise: float = 0.1) -> tuple[F32, U8]:
    """A rendering, and a photo beside it, neither of which is clipped."""
    random = np.random.default_rng(seed)
    photo = random.integers(26, 230, (*SHAPE, 3)).astype(np.uint8)
    apart = random.choice([-1, 1], photo.shape) * random.uniform(0.2 * noise, noise, photo.shape)
    return (photo / 255 + apart).astype(np.float32), photo


def value(rendered: F64, photo: U8, used: Bools, response: Response) -> float:
    """The loss by its formulas in 64 bits, with OpenCV's windows."""
    level = photo / 255
    shown = response.vignetting[..., None] * (response.gain * rendered + response.offset) - 0.055
    as_good = ((photo >= 250) & (shown > level)) | ((photo <= 2) & (shown < level))
    shown = np.where(as_good | ~used[..., None], level, shown)
    charbonnier = (np.sqrt((shown - level) ** 2 + 0.04**2) - 0.04).mean(axis=-1)[used].mean()
    x, y = shown @ (0.299, 0.587, 0.114), level @ (0.299, 0.587, 0.114)

    def blurred(image: F64) -> F64:
        """Means over the part of the window that is inside the image."""
        sums = [cv2.GaussianBlur(one, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT) for one in (image, 1 + 0 * image)]
        return np.asarray(sums[0] / sums[1])

    mx, my = blurred(x), blurred(y)
    sxx, syy, sxy = blurred(x * x) - mx * mx, blurred(y * y) - my * my, blurred(x * y) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * sxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (sxx + syy + 9e-4))
    return float(0.8 * charbonnier + 0.1 * (1 - ssim[used].mean()))


@pytest.mark.parametrize("response", [PLAIN, EXPOSED], ids=["plain", "exposed"])
def test_the_derivative_is_that_of_finite_differences(response: Response) -> None:
    random = np.random.default_rng(1)
    shown, photo = pair(1)
    photo[:4, :4], photo[4:8, :4] = 255, 0  # clipped: some renderings are beyond, others aren't
    light = shown.astype(np.float64) + 0.055
    rendered = (light / response.vignetting[..., None] - response.offset) / response.gain
    used = random.uniform(size=SHAPE) > 0.2
    found = loss.photometric(rendered.astype(np.float32), photo, used, response)
    assert found.value == pytest.approx(value(rendered, photo, used, response), abs=1e-5)
    for _ in range(5):
        direction = random.normal(size=photo.shape)
        ahead, back = (value(rendered + sign * 1e-5 * direction, photo, used, response) for sign in (1, -1))
        measured = (ahead - back) / 2e-5 * used.sum()
        scale = np.linalg.norm(found.gradient) * np.linalg.norm(direction) / np.sqrt(direction.size)
        assert abs(measured - float((found.gradient * direction).sum())) < 0.01 * scale


@pytest.mark.parametrize("shape", [SHAPE, (24, 7), (6, 30), (3, 4)], ids=str)
def test_the_derivative_at_the_borders_is_that_of_finite_differences(shape: tuple[int, int]) -> None:
    """Only the outermost two pixels count; images may be smaller than the windows."""
    random = np.random.default_rng(1)
    rendered, photo = pair(2)
    rendered, photo = rendered[: shape[0], : shape[1]].copy(), photo[: shape[0], : shape[1]].copy()
    used = np.zeros(shape, bool)
    used[:2], used[-2:], used[:, :2], used[:, -2:] = True, True, True, True
    found = loss.photometric(rendered, photo, used, PLAIN)
    assert found.value == pytest.approx(value(rendered.astype(np.float64), photo, used, PLAIN), abs=1e-5)
    for _ in range(5):
        direction = random.normal(size=photo.shape)
        ahead, back = (value(rendered + sign * 1e-5 * direction, photo, used, PLAIN) for sign in (1, -1))
        measured = (ahead - back) / 2e-5 * used.sum()
        scale = np.linalg.norm(found.gradient) * np.linalg.norm(direction) / np.sqrt(direction.size)
        assert abs(measured - float((found.gradient * direction).sum())) < 0.01 * scale


def test_similarity_at_the_borders_is_that_of_the_middle() -> None:
    """Zeros beyond the borders would make the windows there more alike, as they are in both images."""
    photo = np.full((*SHAPE, 3), 102, np.uint8)
    found = loss.photometric(np.full(photo.shape, 0.6, np.float32), photo, np.ones(SHAPE, bool), PLAIN)
    ssim = (2 * 0.6 * 0.4 + 1e-4) / (0.6**2 + 0.4**2 + 1e-4)
    assert found.value == pytest.approx(0.8 * (np.hypot(0.2, 0.04) - 0.04) + 0.1 * (1 - ssim), abs=1e-4)


def test_equal_images_have_no_loss() -> None:
    _, photo = pair(1)
    found = loss.photometric((photo / 255).astype(np.float32), photo, np.ones(SHAPE, bool), PLAIN)
    assert found.value == pytest.approx(0, abs=1e-5) and np.abs(found.gradient).max() < 1e-3 and found.psnr > 80


def test_psnr_is_that_of_the_pixels_that_count() -> None:
    rendered, photo = pair(1)
    used = np.zeros(SHAPE, bool)
    used[5:20] = True
    found = loss.photometric(rendered, photo, used, PLAIN)
    assert found.psnr == pytest.approx(-10 * np.log10(np.square(rendered - photo / 255)[used].mean()), abs=0.01)
    assert np.isnan(loss.photometric(rendered, photo, ~(used | ~used), PLAIN).psnr)


@pytest.mark.parametrize("level", [255, 0])
def test_a_rendering_beyond_what_the_photo_can_show_is_as_good(level: int) -> None:
    photo = np.full((*SHAPE, 3), level, np.uint8)
    beyond = np.full(photo.shape, 1.3 if level else -0.3, np.float32)
    assert not loss.photometric(beyond, photo, np.ones(SHAPE, bool), PLAIN).gradient.any()
    grey = np.full(photo.shape, 0.5, np.float32)
    gradient = loss.photometric(grey, photo, np.ones(SHAPE, bool), PLAIN).gradient
    assert (gradient < 0).all() if level else (gradient > 0).all()


def test_a_dark_photo_shows_what_is_brighter_than_white() -> None:
    """The world's colour is 1.2 there; a photo that shows it as .9 attracts it, though 1.2 can't be displayed."""
    response = Response.of(np.array([0.2834, 0.2834, 0.2834, 0, 0]), falloff(0, 0, *SHAPE))
    photo = np.full((*SHAPE, 3), 227, np.uint8)
    gradients = [
        loss.photometric(np.full(photo.shape, colour, np.float32), photo, np.ones(SHAPE, bool), response).gradient
        for colour in (1.0, 1.4)
    ]
    assert (gradients[0] < 0).all() and (gradients[1] > 0).all()
    assert response.shown(np.full(photo.shape, 1.2, np.float32))[0, 0, 0] == pytest.approx(227 / 255, abs=0.01)


def test_what_is_masked_has_no_effect_on_the_pixels_around() -> None:
    rendered, photo = pair(1, noise=0.05)
    used = np.ones(SHAPE, bool)
    used[8:16, 10:20] = False
    other = rendered.copy()
    other[8:16, 10:20] = (1.0, 0.0, 0.0)
    first, second = (loss.photometric(one, photo, used, PLAIN).gradient for one in (rendered, other))
    assert np.array_equal(first, second) and not first[8:16, 10:20].any()
