"""Photos show the world's colours by their exposure; one that wasn't trained on, by that of its neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.splats import AXIS, GAIN, OFFSET, PHOTO_WIDTH, POSITION
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.texturing.backdrop import photos
from scan2sim.texturing.splats.exposure import Response, falloff, of_nearest

EXPOSURE = np.array([0.2, -0.1, 0.05, 0.12, 0.05])
SHAPE = (12, 20)
LEVELS = np.random.default_rng(1).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)


def test_colours_of_the_world_are_those_after_the_correction_of_the_photo() -> None:
    response = Response.of(EXPOSURE, falloff(EXPOSURE[3], EXPOSURE[4], *SHAPE))
    world = response.world(LEVELS)
    assert np.abs(255 * world - photos._corrected(LEVELS, EXPOSURE)).max() < 0.01
    assert world.max() > 1, "what is brighter than white isn't cut"
    assert np.abs(255 * response.shown(world) - LEVELS).max() < 0.01


def test_a_part_of_the_pixels_has_its_part_of_the_vignetting() -> None:
    response = Response.of(EXPOSURE, falloff(EXPOSURE[3], EXPOSURE[4], *SHAPE))
    part = slice(1, None, 3)
    assert np.allclose(response.sampled(part, part).world(LEVELS[part, part]), response.world(LEVELS)[part, part])


def taken(pose: F64, gain: float) -> F32:
    """A photo's row in a layer."""
    row = np.zeros(PHOTO_WIDTH, np.float32)
    row[POSITION], row[AXIS], row[GAIN], row[OFFSET] = pose[:3, 3], pose[:3, 2], gain, 0.055 * gain
    return row


def ahead(x: float) -> F64:
    return look_at((x, 0.0, 1.7), (x + 10, 0.0, 1.7))


def test_exposure_of_a_photo_between_others_is_interpolated() -> None:
    layer = np.stack([taken(ahead(x), gain) for x, gain in ((0, 1.4), (2, 1.0), (3, 0.7), (9, 0.2))])
    assert of_nearest(layer, ahead(2.5), *SHAPE).gain == pytest.approx([0.85] * 3, abs=0.01)
    assert of_nearest(layer, ahead(2.1), *SHAPE).gain == pytest.approx([0.97] * 3, abs=0.01)
    assert of_nearest(layer, ahead(3.0), *SHAPE).gain == pytest.approx([0.7] * 3, abs=0.01)


def test_exposure_is_that_of_photos_that_look_the_same_way() -> None:
    """The camera at the back sees the sun."""
    back = look_at((2.5, 0.0, 1.7), (-10.0, 0.0, 1.7))
    layer = np.stack([taken(ahead(2), 1.0), taken(back, 0.5), taken(ahead(3), 1.0)])
    assert of_nearest(layer, ahead(2.5), *SHAPE).gain == pytest.approx([1.0] * 3, abs=0.01)


def test_without_photos_the_world_is_shown_as_it_is() -> None:
    colour = np.random.default_rng(1).uniform(0, 1, (*SHAPE, 3)).astype(np.float32)
    shown = of_nearest(np.zeros((0, PHOTO_WIDTH), np.float32), np.eye(4), *SHAPE).shown(colour)
    assert np.abs(shown - colour).max() < 1e-6
