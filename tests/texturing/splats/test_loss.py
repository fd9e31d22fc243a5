"""The derivative of the photometric loss is that of its value."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.texturing.splats import loss


@pytest.mark.parametrize("seed", [1, 2])
def test_the_derivative_is_that_of_finite_differences(seed: int) -> None:
    random = np.random.default_rng(seed)
    photo = random.uniform(0.1, 0.9, (24, 30, 3)).astype(np.float32)
    rendered = np.clip(photo + random.normal(0, 0.1, photo.shape), 0.06, 0.94).astype(np.float32)
    weight = (random.uniform(size=(24, 30)) > 0.2).astype(np.float32)
    _, gradient = loss.photometric(rendered, photo, weight)
    direction = random.normal(size=photo.shape).astype(np.float32)
    step = np.float32(1e-2)
    ahead, back = (loss.photometric(rendered + sign * step * direction, photo, weight)[0] for sign in (1, -1))
    measured = (ahead - back) / (2 * step) * weight.sum()
    inner = np.abs(direction * step).max() < 0.1
    assert inner and measured == pytest.approx(float((gradient * direction).sum()), rel=0.03)


def test_equal_images_have_no_loss_and_masked_pixels_no_gradient_of_colour() -> None:
    photo = np.random.default_rng(1).uniform(0.1, 0.9, (24, 30, 3)).astype(np.float32)
    value, gradient = loss.photometric(photo, photo, np.ones((24, 30), np.float32))
    assert value == pytest.approx(0, abs=1e-5) and np.abs(gradient).max() < 1e-3


def test_a_rendering_beyond_white_is_as_good_as_white() -> None:
    photo = np.full((24, 30, 3), 1.0, np.float32)
    _, gradient = loss.photometric(photo + np.float32(0.3), photo, np.ones((24, 30), np.float32))
    assert not gradient.any()


def test_what_is_masked_has_no_effect_on_the_pixels_around() -> None:
    random = np.random.default_rng(1)
    photo = random.uniform(0.1, 0.9, (24, 30, 3)).astype(np.float32)
    rendered = np.clip(photo + random.normal(0, 0.05, photo.shape), 0, 1).astype(np.float32)
    weight = np.ones((24, 30), np.float32)
    weight[8:16, 10:20] = 0
    other = rendered.copy()
    other[8:16, 10:20] = (1.0, 0.0, 0.0)
    first, second = (loss.photometric(one, photo, weight)[1] for one in (rendered, other))
    assert np.array_equal(first, second) and not first[8:16, 10:20].any()
