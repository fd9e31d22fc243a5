"""A simulator's images: pairs of the same time, encodings of depth, and malformed messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.world_camera.simulator_images import MAX_WAITING, ImagePairs, colour_of, depth_of
from tests.services.world_camera.messages import image

RGB = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
DEPTH = np.linspace(1, 9, 24, dtype=np.float32).reshape(4, 6)


def test_images_of_the_same_time_are_paired_in_any_order() -> None:
    pairs = ImagePairs()
    colours = [image(RGB, "rgb8", 0.1 * k) for k in range(4)]
    depths = [image(DEPTH, "32FC1", 0.1 * k + 0.0005) for k in range(4)]
    assert pairs.add_colour(colours[0]) is None and pairs.add_colour(colours[1]) is None
    pair = pairs.add_depth(depths[1])
    assert pair is not None and pair.colour is colours[1] and pair.depth is depths[1] and pair.time == 10**8
    assert pairs.add_depth(depths[0]) is None, "its image was passed by a later one"
    assert pairs.add_depth(depths[2]) is None
    pair = pairs.add_colour(colours[2])
    assert pair is not None and pair.depth is depths[2]


def test_few_images_wait_for_their_depth() -> None:
    pairs = ImagePairs()
    for k in range(MAX_WAITING + 1):
        assert pairs.add_colour(image(RGB, "rgb8", k)) is None
    assert pairs.add_depth(image(DEPTH, "32FC1", 0)) is None
    assert pairs.add_depth(image(DEPTH, "32FC1", 1)) is not None


def test_colours_and_depths_are_decoded() -> None:
    assert np.array_equal(colour_of(image(RGB[..., ::-1], "bgr8")), RGB)
    assert np.array_equal(depth_of(image(DEPTH, "32FC1")), DEPTH)
    millimetres = (1000 * DEPTH).round().astype(np.uint16)
    assert np.allclose(depth_of(image(millimetres, "16UC1")), DEPTH, atol=1e-3)
    assert np.allclose(depth_of(image(millimetres.byteswap(), "16UC1", is_bigendian=1)), DEPTH, atol=1e-3)
    padded = np.zeros((4, 8), np.float32)
    padded[:, :6] = DEPTH
    assert np.array_equal(depth_of(image(padded, "32FC1", width=6)), DEPTH)


@pytest.mark.parametrize(
    "changed",
    [
        {"encoding": "rgb8"}, {"encoding": "wild"}, {"step": 5}, {"data": np.zeros(10, np.uint8)}, {"height": 10**9},
        {"data": np.zeros(0, np.uint8)}, {"width": 0},
    ],
)  # fmt: skip
def test_malformed_depth_images_are_rejected(changed: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="depth image"):
        depth_of(image(DEPTH, "32FC1", **changed))


@pytest.mark.parametrize("changed", [{"encoding": "wild"}, {"data": np.zeros(0, np.uint8)}, {"step": 2}])
def test_malformed_colour_images_are_rejected(changed: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="colour image"):
        colour_of(image(RGB, "rgb8", **changed))
