"""What a photo says of texels, against a slow reference: place, pose, warp, exposure, halved photos."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.cameras import MODEL_ID, parameters, pixel_angle, project
from scan2sim.pipeline.render import look_at
from scan2sim.pipeline.types import Camera
from scan2sim.texturing import blend
from scan2sim.texturing.photos import OFFSET, Photo

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
    levels = [np.uint8(shown(u, v))]
    for _ in range(2):
        levels.append(np.uint8(np.rint(levels[-1].reshape(len(levels[-1]) // 2, 2, -1, 2, 3).mean(axis=(1, 3)))))
    corner = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * SIDE / 2
    corners = corner[[[0, 1, 2], [0, 2, 3]]].astype(np.float32)
    uv = (corners[..., :2] / SIDE + 0.5).astype(np.float32)
    flat = blend.texels(uv, size, size)
    owner = blend.owners(flat, size, size)
    assert (owner >= 0).all()
    T = np.linalg.inv(POSE)
    gain, fall = np.array([0.1, -0.05, 0.0]), np.array([0.3, 0.2])
    everywhere = np.full((6, 8), np.inf, np.float32)
    look = blend.Look(
        Photo(tuple(levels), levels[0], np.zeros((0, 0), np.uint8)), np.zeros((0, 0), np.uint8),
        MODEL_ID["pinhole"], parameters(CAMERA), everywhere, everywhere, everywhere, 1,
        np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), pixel_angle(CAMERA), np.concatenate([gain, fall]),
        np.tile(np.float32(warp), (3, 4, 1)),
    )  # fmt: skip
    rows = blend.NumbaRows(owner, flat, corners, np.tile(np.float32([0, 0, 1]), (2, 1)))
    weighing = blend.Weighing(bias=0.1, power=1.0, feather=4.0, min_cos=0.1, band=-1)
    rows.add(np.arange(2), np.zeros((2, 3), np.float32), look, weighing)
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
