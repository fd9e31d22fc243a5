"""Photo prediction: what a photo of a wall should show, against the wall's known colours."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.texturing.photo_cache import Photo
from scan2sim.texturing.photo_prediction import Prediction, Predictor, surface

CAMERA = Camera("pinhole", 120, 80, 100.0, 100.0, 59.5, 39.5)
DISTANCE_M = 5.0
NO_CHANGE = np.zeros(5)
GREY = (90, 120, 60)


def pose(x: float) -> F64:
    """Camera at x, looking along z at a wall."""
    T = np.eye(4)
    T[0, 3] = x
    return T


def depth(x: float, wall: float = DISTANCE_M) -> DepthMap:
    rays = pixel_rays(CAMERA)
    return DepthMap(CAMERA, pose(x), (wall / rays[..., 2]).astype(np.float32))


def shown(x: float) -> U8:
    """Photo from x of a wall whose red rises by 20 levels per metre."""
    columns = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx * DISTANCE_M + x
    image = np.empty((CAMERA.height, CAMERA.width, 3), np.uint8)
    image[...] = GREY
    image[..., 0] = np.round(90 + 20 * columns)
    return image


def photo(rgb: U8, mask: U8 | None = None) -> Photo:
    half = rgb[::2, ::2].copy()
    levels = (rgb, half, half[::2, ::2].copy())
    return Photo(levels, half, np.zeros((0, 0), np.uint8) if mask is None else mask)


def predicted(*photos: tuple[float, Photo], wall: float = DISTANCE_M) -> Prediction:
    """Prediction of the photo from x = 0 by others, each with its position."""
    predictor = Predictor(surface(CAMERA, depth(0.0)), len(photos), max_distance=40.0, min_cos=0.1, bias=0.05)
    for x, one in photos:
        predictor.add(one, CAMERA, pose(x), depth(x, wall), NO_CHANGE)
    return predictor.result()


def test_surface_faces_the_camera() -> None:
    seen = surface(CAMERA, depth(0.0))
    assert np.allclose(seen.points[..., 2], DISTANCE_M, atol=1e-4)
    assert np.allclose(seen.normals[5:-5, 5:-5], (0, 0, -1), atol=1e-3)
    points, normals = seen.sample(50, 40.0, np.random.default_rng(0))
    assert len(points) == 50 and np.allclose(points[:, 2], DISTANCE_M, atol=1e-4) and (normals[:, 2] < -0.99).all()
    assert len(seen.sample(50, 1.0, np.random.default_rng(0))[0]) == 0


def test_neighbours_predict_the_colours_of_the_wall() -> None:
    found = predicted(*((x, photo(shown(x))) for x in (-0.6, 0.5, 0.9)))
    middle = np.s_[10:-10, 30:-30]
    assert (found.others[middle] == 3).all() and (found.support[middle] == 3).all()
    assert np.abs(found.rgb[middle] - shown(0.0)[middle]).max() < 2


def test_what_only_one_photo_shows_is_outvoted() -> None:
    ghost = shown(0.5)
    ghost[:, 40:60] = (250, 250, 250)
    found = predicted((-0.6, photo(shown(-0.6))), (0.5, photo(ghost)), (0.9, photo(shown(0.9))))
    middle = np.s_[10:-10, 30:-30]
    assert found.support[middle].min() == 2 and (found.others[middle] == 3).all()
    assert np.abs(found.rgb[middle] - shown(0.0)[middle]).max() < 2


def test_masked_and_hidden_points_have_no_colour() -> None:
    masked = photo(shown(0.5), np.zeros((CAMERA.height, CAMERA.width), np.uint8))
    found = predicted((0.5, masked))
    assert not found.others.any() and not found.support.any() and not found.rgb.any()
    hidden = predicted((0.5, photo(shown(0.5))), wall=3.0)  # something stands in front of the wall
    assert not hidden.others.any()
