"""Projection of points into photos, and sampling of images of any size at photo pixels."""

import numpy as np
import pytest

from scan2sim.pipeline.camera.image_sampling import allows, page_colours, page_taps, read, rescaled
from scan2sim.pipeline.camera.models import inside, parameters, project
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.types import Camera

CAMERAS = {
    "pinhole": Camera("pinhole", 97, 71, 60.0, 62.0, 47.0, 36.0),
    "opencv": Camera("opencv", 97, 71, 60.0, 62.0, 47.0, 36.0, (-0.2, 0.05, 0.001, -0.002)),
    "fisheye": Camera("fisheye", 97, 71, 40.0, 41.0, 47.0, 36.0, (0.02, -0.003, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 142, 71),
    "orthographic": Camera("orthographic", 97, 71, 12.0, 12.0, 47.0, 36.0),
}
POSE = look_at((3.0, -2.0, 4.0), (8.0, 5.0, 3.0))


@pytest.mark.parametrize("name", CAMERAS)
def test_pixels_equal_project_of_points_in_camera_axes(name: str) -> None:
    camera, places = CAMERAS[name], np.random.default_rng(0).uniform(-20, 20, (5000, 3))
    uv, shown = pixels(camera, POSE, places)
    expected, ahead = project(camera, (places - POSE[:3, 3]) @ POSE[:3, :3])
    np.testing.assert_allclose(uv[ahead], expected[ahead], atol=1e-3)
    np.testing.assert_array_equal(shown, ahead & inside(camera, expected))
    assert shown.any() and (name == "equirectangular" or not shown.all())


def test_panorama_projects_points_behind_the_camera() -> None:
    camera = Camera("equirectangular", 400, 200)
    behind = np.array([[0.0, 0.3, -5.0], [-0.0, -1.0, -2.0], [1e-9, 0.0, -1.0]])
    uv, shown = pixels(camera, np.eye(4), behind)
    assert shown.all() and inside(camera, uv).all()


@pytest.mark.parametrize("size", [(71, 97), (35, 48), (18, 24), (9, 200)])
def test_images_of_any_size_are_sampled_at_photo_pixels(size: tuple[int, int]) -> None:
    """A ramp over the whole photo has the same values in an image of any size, within half a pixel of the image."""
    camera = CAMERAS["pinhole"]
    p, (height, width) = parameters(camera), size
    row, column = np.mgrid[:height, :width]
    ramp = np.stack([(column + 0.5) / width, (row + 0.5) / height, 0 * row], axis=-1)
    for u, v in ((-0.5, -0.5), (20.0, 30.0), (90.3, 60.1), (96.4, 70.4)):
        x, y = rescaled(p, u, v, ramp)
        sampled = np.array(read(ramp, p, u, v, False)[:2])
        place = np.array([(u + 0.5) / camera.width, (v + 0.5) / camera.height])
        assert (abs(sampled - place) <= 0.5 / np.array([width, height]) + 1e-9).all()
        if 0 <= x <= width - 1 and 0 <= y <= height - 1:
            np.testing.assert_allclose(sampled, place, atol=1e-9)


def test_masks_apply_up_to_the_border_of_the_photo() -> None:
    p = parameters(CAMERAS["pinhole"])
    mask = np.zeros((7, 9), np.uint8)
    mask[0, 0] = mask[6, 8] = 255
    assert allows(mask, p, -0.5, -0.5) and allows(mask, p, 96.49, 70.49)
    assert not allows(mask, p, 96.49, -0.5) and allows(np.zeros((0, 0), np.uint8), p, 3.0, 3.0)


def test_texture_origin_is_lower_left_and_borders_are_clamped() -> None:
    rng = np.random.default_rng(0)
    page = rng.integers(0, 256, (5, 7, 3), np.uint8)
    uv = rng.uniform(-0.2, 1.2, (200, 2)).astype(np.float32)
    x, y = np.clip(uv[:, 0] * 7 - 0.5, 0, 6), np.clip((1 - uv[:, 1]) * 5 - 0.5, 0, 4)
    left, top = np.minimum(x.astype(int), 5), np.minimum(y.astype(int), 3)
    s, t = (x - left)[:, None], (y - top)[:, None]
    upper = page[top, left] * (1 - s) + page[top, left + 1] * s
    truth = upper * (1 - t) + (page[top + 1, left] * (1 - s) + page[top + 1, left + 1] * s) * t
    assert np.allclose(page_colours(page, uv), truth, atol=1e-3)
    texel, weight = page_taps(page, uv)
    assert np.allclose((weight[..., None] * page.reshape(-1, 3)[texel]).sum(axis=1), truth, atol=1e-3)
