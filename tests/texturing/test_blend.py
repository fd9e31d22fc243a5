"""What photos say of texels: what they show at the texels' places, and line for line as `plain_blend` has it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_angle, project
from scan2sim.pipeline.camera.projection import eye
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.texturing.bake import blend_numba
from scan2sim.texturing.bake import texel_map as texels
from scan2sim.texturing.photo_cache import OFFSET
from tests.texturing import reference_blend
from tests.texturing.scattered import CAMERAS, scattered, taken

CAMERA = Camera("pinhole", 80, 60, 60.0, 62.0, 38.0, 31.0)
POSE = look_at((0.4, -0.6, 3.0), (0.1, 0.2, 0.0))
SIDE = 1.6
"""Metres: a square on the ground, of two faces, on a page of its own."""


def shown(u: Any, v: Any) -> Any:
    """(..., 3) what the photo shows: it changes evenly, so that it is the same however it is interpolated."""
    return np.stack([20 + 2 * u, 180 - 2 * v, 40 + u + v], axis=-1)


@pytest.mark.parametrize("size", [40, 8])  # texels of 4 cm, finer than the photo's pixels, and of 20 cm
@pytest.mark.parametrize("warp", [(0.0, 0.0), (1.5, -2.25)])
def test_texels_show_what_the_photo_shows_there(size: int, warp: tuple[float, float]) -> None:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    whole: U8 = shown(u, v).astype(np.uint8)
    half, quarter = (
        whole.reshape(CAMERA.height // n, n, -1, n, 3).mean(axis=(1, 3)).round().astype(np.uint8) for n in (2, 4)
    )
    corner = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * SIDE / 2
    corners = corner[[[0, 1, 2], [0, 2, 3]]].astype(np.float32)
    uv = (corners[..., :2] / SIDE + 0.5).astype(np.float32)
    flat = texels.corners(uv, size, size)
    owner = texels.owners(flat, size, size)
    assert (owner >= 0).all()
    gain, fall = np.array([0.1, -0.05, 0.0]), np.array([0.3, 0.2])
    everywhere = np.full((6, 8), np.inf, np.float32)
    source = blend_numba.Source(
        blend_numba.Picture(
            whole, half, quarter, whole, np.zeros((0, 0), np.uint8), np.tile(np.array(warp, np.float32), (3, 4, 1)),
            np.concatenate([gain, fall]),
        ),
        eye(CAMERA, POSE), blend_numba.Occlusion(everywhere, pixel_angle(CAMERA), everywhere, everywhere, 1),
    )  # fmt: skip
    rows = blend_numba.NumbaRows(
        blend_numba.Laid(owner, flat, corners, np.tile(np.array([0, 0, 1], np.float32), (2, 1)))
    )
    weighing = blend_numba.Weighing(bias=0.1, power=1.0, feather=4.0, min_cos=0.1, band=-1)
    rows.add(np.arange(2), np.zeros((2, 3), np.float32), source, weighing)
    rgb, seen = np.zeros((size, size, 3), np.uint8), np.zeros((size, size), np.uint8)
    rows.resolve(rgb, seen)
    assert (seen == 255).all()

    row, column = np.mgrid[:size, :size] + 0.5
    places = np.stack([column / size - 0.5, 0.5 - row / size, 0 * row], axis=-1).reshape(-1, 3) * SIDE
    at, ok = project(CAMERA, (places - POSE[:3, 3]) @ POSE[:3, :3])
    assert ok.all()
    middle = np.array([CAMERA.width - 1, CAMERA.height - 1]) / 2
    q = (((at - middle) ** 2).sum(axis=1) / (middle**2).sum())[:, None]
    light = np.exp(gain + fall[0] * q + fall[1] * q**2)
    expected = (shown(*(at + warp).T) + OFFSET) * light - OFFSET
    assert np.abs(rgb.reshape(-1, 3) - expected).max() < 1.6


@pytest.mark.parametrize("band", [2, 0, -1])
@pytest.mark.parametrize("name", CAMERAS)
def test_photos_are_added_as_the_plain_words_have_it(name: str, band: int) -> None:
    camera, rng = CAMERAS[name], np.random.default_rng(7)
    laid = scattered(rng, camera)
    count, shape = len(laid.flat), (*laid.owner.shape, 4)
    fast, plain = (blend_numba.Sums(*(np.zeros(shape, np.float32) for _ in range(2))) for _ in range(2))
    weighing = blend_numba.Weighing(bias=0.05, power=1.5, feather=9.0, min_cos=0.5, band=band)
    seen = 0
    for _ in range(2):
        source, faces = taken(rng, camera, band), rng.permutation(count)[: 3 * count // 4]
        share = (rng.uniform(size=(len(faces), 3)) * rng.choice([0, 1], (len(faces), 1))).astype(np.float32)
        texels = reference_blend.accumulate(plain, laid, faces, share, source, weighing, camera)
        assert blend_numba.accumulate(fast, laid, faces, share, *source, weighing) == len(texels)
        seen += len(texels)
    assert 0.1 < seen / (2 * (laid.owner >= 0).sum()) < 0.6  # many are seen, many are not
    for mine, theirs in zip(fast, plain, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=1e-6 * np.abs(theirs).max())
