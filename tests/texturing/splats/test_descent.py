"""Adam moves splats that pixels show, by their own size, and leaves the others alone."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR, RGB, WIDTH
from scan2sim.texturing.splats.descent import Descent, rates

RATES = rates(0.05, 0.02, 0.01, 0.05, 0.015)


def test_splats_that_no_pixel_shows_stay_where_they_are() -> None:
    """They are within the image, but hidden: their momentum would move them on, and their next step would be large."""
    random = np.random.default_rng(1)
    descent = Descent(random.uniform(0.1, 0.9, (3, WIDTH)).astype(np.float32), np.ones(3, np.float32))
    every, gradients = np.arange(3, dtype=np.int32), random.normal(size=(3, WIDTH)).astype(np.float32)
    for _ in range(3):
        descent.step(every, gradients, RATES)
    before = {name: value.copy() for name, value in descent.save().items()}
    gradients[1] = 0
    descent.step(every, gradients, RATES)
    after = descent.save()
    for name, value in before.items():
        assert np.array_equal(after[name][1], value[1]), name
    assert (after["parameters"][[0, 2]] != before["parameters"][[0, 2]]).any(axis=1).all()


def test_the_first_step_is_the_rate_and_positions_are_in_sizes_of_the_splat() -> None:
    descent = Descent(np.full((2, WIDTH), 0.5, np.float32), np.array([0.1, 2.0], np.float32))
    descent.step(np.arange(2, dtype=np.int32), np.ones((2, WIDTH), np.float32), RATES)
    moved = 0.5 - descent.parameters
    assert moved[:, 0] == pytest.approx([0.05 * 0.1, 0.05 * 2.0], rel=1e-3)
    assert moved[0, 3:] == pytest.approx(RATES[3:], rel=1e-3)


def test_colours_end_at_the_darkest_and_at_the_brightest() -> None:
    descent = Descent(np.full((2, WIDTH), 0.01, np.float32), np.ones(2, np.float32))
    descent.parameters[:, RGB] = [[MIN_COLOUR + 0.01], [MAX_COLOUR - 0.01]]
    gradients = np.ones((2, WIDTH), np.float32)
    gradients[1] = -1
    descent.step(np.arange(2, dtype=np.int32), gradients, RATES)
    assert (descent.parameters[:, RGB] == np.array([[MIN_COLOUR], [MAX_COLOUR]], np.float32)).all()
