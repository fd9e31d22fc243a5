"""The background is changed where it was seen, and its derivative is the adjoint of looking it up."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR
from scan2sim.texturing.splats import background
from scan2sim.texturing.splats.background import HEIGHT_PX, WIDTH_PX, Background, texels


def directions(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(20, 30, 3) random directions, some at the seam of the texture and at the poles."""
    random = np.random.default_rng(seed)
    found = random.normal(size=(20, 30, 3))
    found[0, :, :2] = -1, 0
    found[0, :, 1] = random.uniform(-1e-3, 1e-3, 30)
    found[1] = (1e-4, 1e-4, 1)
    found[2] = (1e-4, -1e-4, -1)
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_scattering_is_the_adjoint_of_looking_up(seed: int) -> None:
    random = np.random.default_rng(seed)
    texture = random.uniform(size=(HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)
    at = texels(directions(seed))
    gradient = random.normal(size=(*at.shape[:2], 3)).astype(np.float32)
    total = np.zeros_like(texture)
    touched = np.empty(4 * gradient.shape[0] * gradient.shape[1], np.int32)
    count = background._scatter(at.reshape(-1, 2), gradient.reshape(-1, 3), total, touched)
    seen = Background(texture).seen(at)
    # OpenCV's lookup has 32 steps between texels
    assert float((texture * total).sum()) == pytest.approx(float((seen * gradient).sum()), abs=0.05 * np.sqrt(count))
    assert set(touched[:count].tolist()) == set(np.flatnonzero(total.any(axis=-1)).tolist())


def test_a_step_goes_against_the_derivative_and_leaves_what_was_not_seen() -> None:
    texture = np.full((HEIGHT_PX, WIDTH_PX, 3), 0.5, np.float32)
    sky = Background(texture)
    at = texels(directions(1))
    for _ in range(30):
        sky.descend(at, sky.seen(at) - np.array([0.7, 0.5, 0.1], np.float32), 0.02)
    assert np.allclose(sky.seen(at), [0.7, 0.5, 0.1], atol=0.02)
    assert (sky.texture != texture).any(axis=-1).sum() < 4 * at.shape[0] * at.shape[1]


def test_colours_end_where_those_of_splats_do() -> None:
    """Files hold no others: what is shown would differ from what was trained."""
    sky = Background(np.full((HEIGHT_PX, WIDTH_PX, 3), 0.5, np.float32))
    at = texels(directions(1))
    away = np.broadcast_to(np.array([1, -1, 0], np.float32), (*at.shape[:2], 3))
    for _ in range(4):
        sky.descend(at, away, 2.0)
    limits = np.array([MIN_COLOUR, MAX_COLOUR], np.float32)
    assert sky.texture[..., 0].min() == limits[0] and sky.texture[..., 1].max() == limits[1]
    assert np.allclose(sky.seen(at), [*limits, 0.5], atol=0.2)
    sky.recolour(np.full(3, 2, np.float32), np.full(3, -0.1, np.float32))
    assert sky.texture.min() == limits[0] and sky.texture.max() == limits[1]
    assert np.allclose(sky.texture[..., 2], 0.9)


def test_a_saved_background_continues_as_it_would_have() -> None:
    at = texels(directions(1))
    gradients = np.random.default_rng(1).normal(size=(6, *at.shape[:2], 3)).astype(np.float32)
    whole = Background(np.full((HEIGHT_PX, WIDTH_PX, 3), 0.5, np.float32))
    for gradient in gradients[:3]:
        whole.descend(at, gradient, 0.02)
    resumed = Background.load(whole.save())
    for one in (whole, resumed):
        for gradient in gradients[3:]:
            one.descend(at, gradient, 0.02)
    assert np.array_equal(whole.texture, resumed.texture)
