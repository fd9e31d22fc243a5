"""Blending of photos into texels: sampled at the right positions, and equal to the reference implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_angle, project
from scan2sim.pipeline.camera.projection import posed_camera
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.texturing import texel_map as texels
from scan2sim.texturing.bake import blend_numba
from scan2sim.texturing.photo_cache import SRGB_OFFSET
from tests.texturing import reference_blend
from tests.texturing.scattered import CAMERAS, random_photo, random_squares

CAMERA = Camera("pinhole", 80, 60, 60.0, 62.0, 38.0, 31.0)
POSE = look_at((0.4, -0.6, 3.0), (0.1, 0.2, 0.0))
SIDE = 1.6
"""Side in metres of a square on the ground, which consists of two faces on its own page."""


def photo_colour(u: Any, v: Any) -> Any:
    """(..., 3) colours of the photo: linear in u and v, so that all interpolation methods give the same."""
    return np.stack([20 + 2 * u, 180 - 2 * v, 40 + u + v], axis=-1)


@pytest.mark.parametrize("size", [40, 8])  # texels of 4 cm, finer than the photo's pixels, and of 20 cm
@pytest.mark.parametrize("warp", [(0.0, 0.0), (1.5, -2.25)])
def test_texels_have_the_colour_of_the_photo(size: int, warp: tuple[float, float]) -> None:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    whole: U8 = photo_colour(u, v).astype(np.uint8)
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
    source = blend_numba.BlendSource(
        blend_numba.PhotoData(
            whole, half, quarter, whole, np.zeros((0, 0), np.uint8), np.tile(np.array(warp, np.float32), (3, 4, 1)),
            np.concatenate([gain, fall]),
        ),
        posed_camera(CAMERA, POSE), blend_numba.Occlusion(everywhere, pixel_angle(CAMERA), everywhere, everywhere, 1),
    )  # fmt: skip
    rows = blend_numba.NumbaRowBlender(
        blend_numba.PageFaces(owner, flat, corners, np.tile(np.array([0, 0, 1], np.float32), (2, 1)))
    )
    settings = blend_numba.BlendSettings(bias=0.1, power=1.0, feather=4.0, min_cos=0.1, band=-1)
    rows.add(np.arange(2), np.zeros((2, 3), np.float32), source, settings)
    rgb, seen = np.zeros((size, size, 3), np.uint8), np.zeros((size, size), np.uint8)
    rows.resolve(rgb, seen, 255.0)
    assert (seen == 255).all()

    row, column = np.mgrid[:size, :size] + 0.5
    points = np.stack([column / size - 0.5, 0.5 - row / size, 0 * row], axis=-1).reshape(-1, 3) * SIDE
    at, ok = project(CAMERA, (points - POSE[:3, 3]) @ POSE[:3, :3])
    assert ok.all()
    middle = np.array([CAMERA.width - 1, CAMERA.height - 1]) / 2
    q = (((at - middle) ** 2).sum(axis=1) / (middle**2).sum())[:, None]
    light = np.exp(gain + fall[0] * q + fall[1] * q**2)
    expected = (photo_colour(*(at + warp).T) + SRGB_OFFSET) * light - SRGB_OFFSET
    assert np.abs(rgb.reshape(-1, 3) - expected).max() < 1.6


@pytest.mark.parametrize("band", [2, 0, -1])
@pytest.mark.parametrize("name", CAMERAS)
def test_accumulate_equals_reference_implementation(name: str, band: int) -> None:
    camera, rng = CAMERAS[name], np.random.default_rng(7)
    page_faces = random_squares(rng, camera)
    count, shape = len(page_faces.flat), (*page_faces.owner.shape, 4)
    kernel, reference = (blend_numba.Sums(*(np.zeros(shape, np.float32) for _ in range(2))) for _ in range(2))
    settings = blend_numba.BlendSettings(bias=0.05, power=1.5, feather=9.0, min_cos=0.5, band=band)
    seen = 0
    for _ in range(2):
        source, faces = random_photo(rng, camera, band), rng.permutation(count)[: 3 * count // 4]
        share = (rng.uniform(size=(len(faces), 3)) * rng.choice([0, 1], (len(faces), 1))).astype(np.float32)
        texels = reference_blend.accumulate(reference, page_faces, faces, share, source, settings, camera)
        assert blend_numba.accumulate(kernel, page_faces, faces, share, *source, settings) == len(texels)
        seen += len(texels)
    assert 0.1 < seen / (2 * (page_faces.owner >= 0).sum()) < 0.6  # many texels are seen, many are not
    for actual, expected in zip(kernel, reference, strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-6 * np.abs(expected).max())
