"""Facade stereo: a textured wall on a known plane, seen by cameras with known poses along a street."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest

from scan2sim.pipeline.buildings.facade_completion import Wall
from scan2sim.pipeline.buildings.facade_stereo import LIMITS, Photo, evidence, photo_consistency, rectify
from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.models import unproject
from scan2sim.pipeline.core.types import F32, F64, U8, Camera, View

CELL, LENGTH, HEIGHT, SCANNED = 0.1, 5.0, 3.6, 1.2  # metres; rows below SCANNED are known
CAMERA = Camera("pinhole", 480, 360, 240.0, 240.0, 239.5, 219.5)
POSITIONS = np.linspace(0.0, 5.0, 8)  # of the cameras along x; they look along y
DISTANCE, EYE = 7.0, 1.7
WINDOW = round(0.75 / CELL) * 2 + 1
INNER = (slice(16, 30), slice(8, 42))  # cells above the scanned part that all photos see


def wall(y: float = DISTANCE) -> Wall:
    """A wall at a distance, facing the cameras."""
    known = np.zeros((round(HEIGHT / CELL), round(LENGTH / CELL)), bool)
    known[: round(SCANNED / CELL)] = True
    axes = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, -1.0, 0])
    return Wall(0, np.array([CELL / 2, y, CELL / 2]), *axes, CELL, known)


@cache
def pattern(seed: int) -> F64:
    """Smoothed noise, pixels of 4 cm."""
    return np.asarray(cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, (500, 1000)), (0, 0), 1.2))


def texture(x: F64, z: F64, seed: int = 0) -> F64:
    """Grey levels of a pattern of 10 cm, without any repetition within 30 m."""
    noise = pattern(seed)
    u, v = (x + 10) / 0.04, (z + 10) / 0.04
    grey = cv2.remap(noise, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(128 + 2.5 * (grey.reshape(x.shape) - 128))


def rays(position: float) -> tuple[F64, F64]:
    """Centre of a camera, and the directions (H, W, 3) of its pixels."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = unproject(CAMERA, np.column_stack([u.ravel(), v.ravel()]))[:, [0, 2, 1]] * (1, 1, -1)
    return np.array([position, 0.0, EYE]), ray.reshape(CAMERA.height, CAMERA.width, 3)


def photograph(
    position: float,
    surface: float = DISTANCE,
    plain: float | None = None,
    scanned: float | None = DISTANCE,
    gain: float = 1.0,
    seed: int = 0,
) -> Photo:
    """A photo of a textured (or plain) surface; its range image has a wall at `scanned`, or nothing."""
    centre, ray = rays(position)
    far = surface / ray[..., 1]
    x, z = centre[0] + far * ray[..., 0], centre[2] + far * ray[..., 2]
    grey = np.full(x.shape, plain) if plain is not None else texture(x, z, seed)
    grey = gain * (grey + np.random.default_rng(int(100 * position)).normal(0, 1.5, grey.shape))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), centre
    view = View(f"{position:.1f}", CAMERA, pose, Path("photo.png"))
    level = np.clip(grey, 0, 255).astype(np.uint8)
    half = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    reach = np.full(x.shape, np.inf) if scanned is None else scanned / ray[..., 1] * np.linalg.norm(ray, axis=2)
    return Photo(view, (level, np.asarray(half)), None, None, DepthMap(CAMERA, pose, reach.astype(np.float32)))


def photos(surface: float = DISTANCE, plain: float | None = None, scanned: float | None = DISTANCE) -> list[Photo]:
    """Photos from all positions."""
    return [photograph(x, surface, plain, scanned) for x in POSITIONS]


def turned(photo: Photo, degrees: float) -> Photo:
    """The photo with a wrong heading."""
    a = np.radians(degrees)
    pose = photo.view.T_world_cam.copy()
    pose[:3, :3] = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ pose[:3, :3]
    return replace(photo, view=replace(photo.view, T_world_cam=pose))


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Use one thread, as step `facades` does: with images this small, starting threads would dominate the run time."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


@pytest.fixture(scope="module")
def seen() -> list[Photo]:
    """Photos of the textured wall."""
    return photos()


def test_rectified_photo_equals_the_pattern_of_the_wall(seen: list[Photo]) -> None:
    """Tolerance: noise of the photos, and blur by sampling at their resolution (3 cm)."""
    patch = rectify(wall(), seen[3])
    rows, columns = np.mgrid[: patch.grey.shape[0], : patch.grey.shape[1]]
    true = texture((columns + 0.5) * CELL / 2, (rows + 0.5) * CELL / 2)
    assert np.corrcoef(patch.grey[patch.seen], true[patch.seen])[0, 1] > 0.98
    shifted = texture((columns + 1.5) * CELL / 2, (rows + 0.5) * CELL / 2)  # one texel
    assert np.corrcoef(patch.grey[patch.seen], shifted[patch.seen])[0, 1] < 0.9


def test_photo_consistency_is_highest_on_the_plane_of_the_wall(seen: list[Photo]) -> None:
    """One texel of disparity between the outer cameras is 5 cm * 7 m / 5 m = 7 cm of depth."""
    offsets = np.arange(-0.4, 0.41, 0.1)
    found = wall(DISTANCE + 0.1)  # the true plane is 10 cm in front of it
    scores = [photo_consistency([rectify(found, p, o) for p in seen], WINDOW)[0] for o in offsets]
    best = offsets[np.argmax(scores, axis=0)][2 * INNER[0].start : 2 * INNER[0].stop, 20:-20]
    assert np.abs(best + 0.1).max() < 0.05 and np.max(scores) > 0.95


def inner(photos: list[Photo]) -> F32:
    """Evidence of the cells above the scanned part."""
    return evidence(wall(), photos)[0][INNER]


def test_texture_on_the_wall_is_evidence_at_any_exposure(seen: list[Photo]) -> None:
    gains = (0.5, 0.9, 0.7, 0.6, 1.0, 0.8, 0.55, 0.95)
    assert inner([photograph(x, gain=g) for x, g in zip(POSITIONS, gains, strict=True)]).min() > 0.4


@pytest.mark.parametrize("surface", [6.3, 7.7, 9.0])
def test_texture_on_another_plane_is_evidence_against_the_wall(surface: float) -> None:
    """The wall ends where scanned; photos show a surface above it that is 70 cm in front, or 70 cm or 2 m behind."""
    assert inner(photos(surface, scanned=None)).max() < -0.4


@pytest.mark.parametrize(("level", "low", "high"), [(120.0, 0.0, 0.1), (250.0, -0.2, 0.0)])
def test_untextured_walls_give_weak_or_no_evidence(level: float, low: float, high: float) -> None:
    """With the colour of the scanned part: weak evidence; overexposed: none."""
    value = inner(photos(plain=level))
    assert low <= value.min() and value.max() <= high


def test_plain_colour_unlike_the_scanned_part_is_evidence_against_the_wall() -> None:
    """The wall ends where scanned, in front of an evenly grey sky."""
    made = []
    for photo in photos(plain=100.0):
        _, ray = rays(float(photo.view.T_world_cam[0, 3]))
        above = EYE + DISTANCE * ray[..., 2] / ray[..., 1] > SCANNED
        made.append(replace(photo, levels=(np.where(above, 180, photo.levels[0]).astype(np.uint8),)))
    assert inner(made).max() == pytest.approx(-0.4, abs=0.05)
    edge = evidence(wall(), made)[1]
    row = round(SCANNED / CELL)
    assert edge[row - 2 : row + 1, 10:-10].max(axis=0).min() > 0.9  # a sharp edge at its top, and nowhere else
    assert edge[row + 2 :].max() < 0.2


def test_cells_occluded_by_scanned_objects_are_unknown(seen: list[Photo]) -> None:
    assert inner(photos(5.0, scanned=5.0)) == pytest.approx(LIMITS.unseen_value)
    free = [p if k % 2 else photograph(POSITIONS[k], 5.0, scanned=5.0) for k, p in enumerate(seen)]
    assert inner(free).min() > 0.4, "four photos without an occluder are sufficient"


def test_unscanned_occluder_does_not_count_as_wall() -> None:
    assert inner(photos(5.0)).max() < -0.3


def test_wrong_poses_give_no_evidence_and_two_of_eight_are_tolerated(seen: list[Photo]) -> None:
    """Heading errors of up to 6 degrees; those of adjacent photos differ by 17 cm on the wall."""
    assert inner([turned(p, d) for p, d in zip(seen, np.linspace(-6, 6, 8), strict=True)]).max() < 0.05
    assert inner([turned(p, 5.0 * (k in (0, 4))) for k, p in enumerate(seen)]).min() > 0.4


def test_cells_seen_by_one_photo_or_masked_give_no_evidence(seen: list[Photo]) -> None:
    nothing: U8 = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    masked = [replace(p, usable=nothing) for p in seen[1:]]
    for given in (masked + seen[:1], seen[:1], []):
        value, edge = evidence(wall(), given)
        assert value == pytest.approx(LIMITS.unseen_value) and not edge.any()


def test_sky_is_evidence_against_the_wall(seen: list[Photo]) -> None:
    sky: U8 = np.full((45, 60), 255, np.uint8)
    assert inner([replace(p, sky=sky) for p in seen]).max() < -0.4
