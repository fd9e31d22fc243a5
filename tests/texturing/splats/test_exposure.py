"""Photos show the world's colours by their exposure; one that wasn't trained on, by that of its neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.splats import AXIS, CAMERA, GAIN, OFFSET, PHOTO_WIDTH, POSITION, VIGNETTING
from scan2sim.pipeline.core.types import F32, F64, U8
from scan2sim.texturing.backdrop import photos
from scan2sim.texturing.splats.exposure import Gains, Response, falloff, of_nearest

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
    assert of_nearest(layer, ahead(2.5), *SHAPE, 0).gain == pytest.approx([0.85] * 3, abs=0.01)
    assert of_nearest(layer, ahead(2.1), *SHAPE, 0).gain == pytest.approx([0.97] * 3, abs=0.01)
    assert of_nearest(layer, ahead(3.0), *SHAPE, 0).gain == pytest.approx([0.7] * 3, abs=0.01)


def test_exposure_is_that_of_photos_that_look_the_same_way() -> None:
    """The camera at the back sees the sun."""
    back = look_at((2.5, 0.0, 1.7), (-10.0, 0.0, 1.7))
    layer = np.stack([taken(ahead(2), 1.0), taken(back, 0.5), taken(ahead(3), 1.0)])
    assert of_nearest(layer, ahead(2.5), *SHAPE, 0).gain == pytest.approx([1.0] * 3, abs=0.01)


def test_without_photos_the_world_is_shown_as_it_is() -> None:
    colour = np.random.default_rng(1).uniform(0, 1, (*SHAPE, 3)).astype(np.float32)
    shown = of_nearest(np.zeros((0, PHOTO_WIDTH), np.float32), np.eye(4), *SHAPE, None).shown(colour)
    assert np.abs(shown - colour).max() < 1e-6


def test_exposure_is_that_of_photos_of_the_same_camera() -> None:
    """That of the other camera of a stereo rig has another white balance, and a lens of its own."""
    layer = np.stack([taken(ahead(x), gain) for x, gain in ((0, 1.0), (0, 0.5), (2, 1.0), (2, 0.5))])
    layer[1::2, CAMERA] = 1
    layer[:, VIGNETTING] = 0.3, 0.1
    left, right, other, unknown = (of_nearest(layer, ahead(0.1), *SHAPE, k) for k in (0, 1, 2, None))
    assert left.gain == pytest.approx([1.0] * 3, abs=0.01) and right.gain == pytest.approx([0.5] * 3, abs=0.01)
    assert left.vignetting == pytest.approx(falloff(0.3, 0.1, *SHAPE))
    for one in (other, unknown):
        assert one.gain == pytest.approx([0.75] * 3, abs=0.01) and one.vignetting.shape == (1, 1)


PLAIN = Response.of(np.zeros(5), falloff(0, 0, *SHAPE))
EVERY = np.ones(SHAPE, bool)


def faces() -> tuple[list[F32], list[U8]]:
    """Colours of two faces of a panorama, of which one shows nothing but sky, and their levels in a darker photo."""
    world = np.random.default_rng(1).uniform(0.1, 0.9, (2, *SHAPE, 3)).astype(np.float32)
    world[1] = 0.7
    return list(world), [np.rint(255 * (0.8 * one + 0.02)).astype(np.uint8) for one in world]


def enlarged(image: np.ndarray, times: int) -> np.ndarray:
    """An image (H, W, ...) with each pixel repeated."""
    return np.repeat(np.repeat(image, times, axis=0), times, axis=1)


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
def test_gain_of_a_photo_is_solved_over_all_of_its_shots(order: tuple[int, int]) -> None:
    world, levels = faces()
    gains = Gains(np.array([0, 1, 1], np.int32))
    for shot in order:
        gains.solve(shot, world[shot - 1], levels[shot - 1], EVERY, PLAIN, 1.0)
    together = Gains(np.zeros(1, np.int32))
    together.solve(0, np.concatenate(world), np.concatenate(levels), np.concatenate([EVERY] * 2), PLAIN, 1.0)
    assert np.allclose(gains.gain[1], together.gain[0]) and np.allclose(gains.offset[1], together.offset[0])
    assert gains.gain[1] == pytest.approx([0.8] * 3, abs=0.02) and (gains.gain[0] == 1).all()


def test_shots_in_other_sizes_count_by_what_they_show() -> None:
    """The face with the sky was visited in full size, the other one in half of it."""
    world, levels = faces()
    gains, equal = (Gains(np.zeros(2, np.int32)) for _ in range(2))
    for shot in (1, 0):
        equal.solve(shot, world[shot], levels[shot], EVERY, PLAIN, 1.0)
        times = (3, 6)[shot]
        rendered, rgb, used = (enlarged(one, times) for one in (world[shot], levels[shot], EVERY))
        gains.solve(shot, rendered, rgb, used, PLAIN, 1.0)
    assert np.allclose(gains.sums[:, 0], equal.sums[:, 0])
    assert np.allclose(gains.gain, equal.gain, atol=0.01)


def test_earlier_visits_count_as_the_recoloured_world_shows_them() -> None:
    world, levels = faces()
    gains = Gains(np.array([0, 0, 1], np.int32))
    for shot in (0, 1):
        gains.solve(shot, world[shot], levels[shot], EVERY, PLAIN, 1.0)
    factor, shift = gains.centre()
    expected = Gains(np.array([0, 0], np.int32))
    for shot in (0, 1):
        expected.solve(shot, world[shot] * factor + shift, levels[shot], EVERY, PLAIN, 1.0)
    assert factor.max() < 0.95 and np.allclose(gains.sums[:2], expected.sums, atol=1e-5)
