"""Baking with torch (here on its CPU device) against baking with numba."""

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.bake import blend_numba
from tests.texturing import scattered
from tests.texturing.corner import CAMERAS, POSES, Street, photograph, points

pytest.importorskip("torch", reason="torch is not installed (pip install 'scan2sim[segmentation]')")


COMBINATIONS = [
    pytest.param(name, band, marks=() if (band, name) == (2, "pinhole") else pytest.mark.slow)
    for name in CAMERAS
    for band in (2, 0, -1)
]
"""One combination by default, the others only in slow runs: `test_torch_blends_equally` tests the kernel with all."""


@pytest.mark.parametrize(("name", "band"), COMBINATIONS)
def test_torch_bakes_equal_pages(street: Street, name: str, band: int) -> None:
    camera = CAMERAS[name]
    mask = np.full((camera.height, camera.width), 255, np.uint8)
    mask[: camera.height // 3, : camera.width // 4] = 0
    for i, pose in enumerate(POSES):
        street.add(camera, pose, photograph(camera, pose, gain=1 + 0.1 * i), mask if i == 1 else None)
    street.clouds["terrain"] = points()
    by_numba, done = street.run(band=band, device="numba")
    by_torch, done_torch = street.run(band=band, device="cpu")
    for page in range(done.metrics["pages"]):
        a, b = (image.read_rgb(folder / f"page_{page}.png").astype(int) for folder in (by_numba, by_torch))
        seen = [image.read_levels(folder / f"page_{page}_seen.png") for folder in (by_numba, by_torch)]
        assert (seen[0] == seen[1]).mean() > 0.99999
        assert (abs(a - b).max(axis=2) <= 1).mean() > 0.99999
    assert done_torch.metrics["coverage"] == pytest.approx(done.metrics["coverage"], abs=1e-4)


@pytest.mark.parametrize("band", [2, 0, -1])
@pytest.mark.parametrize("name", scattered.CAMERAS)
def test_torch_blends_equally(name: str, band: int) -> None:
    from scan2sim.texturing.bake.blend_torch import TorchRowBlender

    camera, rng = scattered.CAMERAS[name], np.random.default_rng(7)
    page_faces = scattered.random_squares(rng, camera)
    source, faces = scattered.random_photo(rng, camera, band), np.arange(len(page_faces.flat))
    share = rng.choice([0, 1], (len(faces), 3)).astype(np.float32)
    settings = blend_numba.BlendSettings(bias=0.05, power=1.5, feather=9.0, min_cos=0.5, band=band)
    pages = []
    for rows in (blend_numba.NumbaRowBlender(page_faces), TorchRowBlender(page_faces, "cpu")):
        rgb, seen = np.zeros((*page_faces.owner.shape, 3), np.uint8), np.zeros(page_faces.owner.shape, np.uint8)
        texels = rows.add(faces, share, source, settings)
        rows.resolve(rgb, seen, 340.0)
        assert texels == (seen == 255).sum() > 500
        pages.append(rgb.astype(int))
    assert abs(pages[0] - pages[1]).max() <= 1


def test_unavailable_device_is_reported(street: Street) -> None:
    street.add(CAMERAS["pinhole"], POSES[0])
    with pytest.raises(SettingError, match="xpu:7"):
        street.run(device="xpu:7")
