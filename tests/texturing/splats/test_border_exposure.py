"""Exposure of splats at the border of two tiles, whose worlds have different exposures."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.splats import CAMERA, GAIN, OFFSET, PHOTO_WIDTH, POSITION, RGB, Splats
from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.texturing.splats.border_exposure import FADE_M, with_border_exposure
from scan2sim.texturing.splats.exposure import CURVE_OFFSET

BORDER_M = 50.0
SEEDS = {"first": (0.0, 0.0), "second": (2 * BORDER_M, 0.0)}
WORLDS = {"first": (0.8, 0.02), "second": (1.25, -0.03)}
"""Gain and offset by which the colours of each tile's world differ from the true ones."""
ORIGIN = (-1000.0, 300.0)
GREY_LEVEL = 1 / 255


def cell_of(name: str) -> Cell:
    x, y = ORIGIN
    seeds = {one: (x + at[0], y + at[1]) for one, at in SEEDS.items()}
    return Cell(seeds[name], {one: seed for one, seed in seeds.items() if one != name})


def tile(name: str, colour: F32) -> tuple[Splats, F32]:
    """Splats of a tile every half metre along the street, of one true colour, and its photos, which get brighter."""
    gain, offset = WORLDS[name]
    x = np.arange(0.25, 2 * BORDER_M, 0.5)
    x = x[x < BORDER_M] if name == "first" else x[x > BORDER_M]
    xyz = np.column_stack([x, np.zeros((len(x), 2))])
    count = len(x)
    splats = Splats.of(
        xyz, np.full((count, 3), 0.1), np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 0.9),
        np.tile(gain * colour + offset, (count, 1)),
    )  # fmt: skip
    photos = np.zeros((60, PHOTO_WIDTH), np.float32)
    photos[:, POSITION.start] = np.arange(60) + (0 if name == "first" else 40)
    own = 0.7 + photos[:, POSITION.start, None] / 100  # a photo shows own * true colour
    photos[:, GAIN], photos[:, OFFSET] = own / gain, CURVE_OFFSET - own / gain * offset
    photos[:, CAMERA] = 0
    return splats, photos


@pytest.fixture
def colour() -> F32:
    return np.array([0.2, 0.4, 0.6], np.float32)


def test_tiles_agree_at_their_border_and_keep_their_exposure_inside(colour: F32) -> None:
    shown = {}
    for name in SEEDS:
        splats, photos = tile(name, colour)
        shown[name] = with_border_exposure(splats, photos, cell_of(name), ORIGIN)[0].rgb
        inside = np.abs(splats.xyz[:, 0] - BORDER_M) > FADE_M
        assert np.allclose(shown[name][inside], splats.rgb[inside], atol=1e-6)
        steps = np.abs(np.diff(shown[name], axis=0))
        assert steps.max() < 2 * GREY_LEVEL, "it changes gradually"
    before = np.abs(tile("first", colour)[0].rgb[-1] - tile("second", colour)[0].rgb[0])
    after = np.abs(shown["first"][-1] - shown["second"][0])
    assert before.min() > 10 * GREY_LEVEL and after.max() < 4 * GREY_LEVEL


def test_photos_show_the_changed_colours_as_before(colour: F32) -> None:
    splats, photos = tile("first", colour)
    at_photo = Splats(splats.parameters[[-1] * len(photos)].copy())
    at_photo.parameters[:, :3] = photos[:, POSITION]
    changed, shown_by = with_border_exposure(at_photo, photos, cell_of("first"), ORIGIN)
    before, after = (p[:, GAIN] * s.rgb + p[:, OFFSET] for s, p in ((at_photo, photos), (changed, shown_by)))
    assert np.abs(after - before).max() < 1e-5


def test_borders_without_photos_change_nothing(colour: F32) -> None:
    splats, photos = tile("first", colour)
    far = photos[photos[:, POSITION.start] < 20]
    changed, shown_by = with_border_exposure(splats, far, cell_of("first"), ORIGIN)
    assert np.allclose(changed.parameters[:, RGB], splats.parameters[:, RGB], atol=1e-6)
    assert np.allclose(shown_by, far, atol=1e-6)
