"""Correspondences between photos of a wall: pixels in which the true poses show its points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core.types import F64, U8, Camera, View
from scan2sim.texturing.pose_refinement.matches import Matches, grey_photo, matches

CAMERA = Camera("pinhole", 320, 240, 260.0, 260.0, 159.5, 119.5)
HALF = CAMERA.resized(160, 120)
WALL_M = 6.0
RNG = np.random.default_rng(2)
WAVES, PHASES = RNG.normal(0, 1, (40, 2)) * np.geomspace(3, 20, 40)[:, None], RNG.uniform(0, 6, 40)
NO_MASK = np.zeros((0, 0), np.uint8)


def pose(x: float, turn: float = 0.0) -> F64:
    """Camera at x, looking along z at a wall, turned about its vertical axis by `turn` radians."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[0, 3] = x
    return T


def on_wall(T: F64, camera: Camera) -> F64:
    """(H, W, 3) points of the wall in the camera's pixels."""
    rays = pixel_rays(camera) @ T[:3, :3].T
    return np.asarray(T[:3, 3] + rays * ((WALL_M - T[2, 3]) / rays[..., 2:]))


def shown(T: F64) -> U8:
    """Photo of the wall, which has a pattern that nowhere repeats."""
    at = on_wall(T, CAMERA)[..., :2]
    grey = sum(np.sin(at @ wave + phase) for wave, phase in zip(WAVES, PHASES, strict=True))
    return np.repeat(np.clip(128 + 12 * grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def matched(true: list[F64], given: list[F64], masks: list[U8]) -> Matches:
    """Matches of two photos, taken at the `true` poses, with the poses `given`."""
    views = [View(str(i), CAMERA, T, Path("none")) for i, T in enumerate(given)]
    photos = {i: grey_photo(shown(T), mask, CAMERA) for i, (T, mask) in enumerate(zip(true, masks, strict=True))}

    def depth(i: int) -> DepthMap:
        distance = np.linalg.norm(on_wall(given[i], HALF) - given[i][:3, 3], axis=-1)
        return DepthMap(HALF, given[i], distance.astype(np.float32))

    return matches(views, photos, depth, {0: [1], 1: [0]}, count=200, max_distance=40.0)


def true_pixels(found: Matches, true: list[F64]) -> F64:
    """Pixels (N, 2) in which the photos show the matched corners: the first photo's corner, seen in the other one."""
    out = np.empty_like(found.uv)
    for n, (p, j) in enumerate(zip(found.point_index, found.view, strict=True)):
        T = true[found.first[p]]
        u, v = found.corner[p]
        ray = T[:3, :3] @ [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
        at = T[:3, 3] + ray * (WALL_M - T[2, 3]) / ray[2]
        out[n] = project(CAMERA, ((at - true[j][:3, 3]) @ true[j][:3, :3])[None])[0][0]
    return out


def test_points_are_on_the_wall_and_pixels_are_right() -> None:
    true = [pose(0.0), pose(0.8)]
    found = matched(true, true, [NO_MASK] * 2)
    assert len(found.uv) > 100 and set(found.view.tolist()) == {0, 1}
    assert np.allclose(found.point[:, 2], WALL_M, atol=0.01) and (found.normal[:, 2] < -0.999).all()
    error = np.linalg.norm(found.uv - true_pixels(found, true), axis=1)
    assert np.median(error) < 0.05 and np.percentile(error, 95) < 0.2


def test_a_wrong_pose_is_measured_by_the_offsets() -> None:
    true, given = [pose(0.0), pose(0.8)], [pose(0.0), pose(0.8, 0.02)]  # 5 pixels
    found = matched(true, given, [NO_MASK] * 2)
    error = np.linalg.norm(found.uv - true_pixels(found, true), axis=1)
    assert len(found.uv) > 100 and np.median(error) < 0.1
    point = found.point[found.point_index]
    T = given[1]
    predicted, _ = project(CAMERA, (point - T[:3, 3]) @ T[:3, :3])
    offset = (found.uv - predicted)[found.view == 1]
    assert abs(np.median(offset[:, 0]) - 0.02 * CAMERA.fx) < 1.0 and abs(np.median(offset[:, 1])) < 0.2


def test_masked_parts_are_not_matched() -> None:
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, 160:] = 0
    true = [pose(0.0), pose(0.8)]
    found = matched(true, true, [mask, mask])
    assert len(found.uv) and (found.corner[:, 0] < 160).all() and (found.uv[:, 0] < 160.5).all()
    nothing = np.zeros_like(mask)
    assert len(matched(true, true, [nothing, nothing]).uv) == 0
