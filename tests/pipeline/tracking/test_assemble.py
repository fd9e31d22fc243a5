"""Tracks in simulated sweeps: cars, a cyclist and a pedestrian on a plane; the scanner sees their near sides."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, Frame, PointCloud, Trajectory
from scan2sim.pipeline.tracking import overlaps
from scan2sim.pipeline.tracking.assemble import Candidate, assemble, without_overlaps
from scan2sim.pipeline.tracking.tracks import Category, Track, footprint

PERIOD_S, SWEEPS, EGO_MPS = 0.1, 30, 10.0
RAY_RAD = 0.004
Size = tuple[float, float, float]
ACTORS: dict[str, tuple[Category, Size, float, float, float, float]] = {
    # category, size, x and y at the start, speed, yaw
    "ahead": ("car", (4.2, 1.75, 1.5), 16.0, 0.0, 11.0, 0.0),
    "oncoming": ("car", (4.4, 1.8, 1.45), 45.0, 3.6, 13.0, np.pi),
    "cyclist": ("cyclist", (1.75, 0.6, 1.75), 12.0, -2.5, 5.0, 0.0),
    "pedestrian": ("pedestrian", (0.6, 0.55, 1.7), 20.0, 8.0, 1.4, np.pi / 2),
}


def pose(name: str, time: float) -> F64:
    _, _, x, y, speed, yaw = ACTORS[name]
    return np.array([x + speed * np.cos(yaw) * time, y + speed * np.sin(yaw) * time, 0.0, yaw])


def returns(size: Size, at: F64, scanner: F64, rng: np.random.Generator) -> F64:
    """Points of the sides of a box that face the scanner, as dense as its rays."""
    corners = footprint(size, at)
    parts = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        outwards = np.array([(b - a)[1], -(b - a)[0]]) / np.linalg.norm(b - a)
        to = scanner - (a + b) / 2
        facing = float(outwards @ to) / float(np.linalg.norm(to))
        if facing < 0.02:
            continue
        spacing = RAY_RAD * float(np.linalg.norm(to))
        columns = max(1, int(np.linalg.norm(b - a) * facing / spacing))
        rows = max(1, int(size[2] / spacing / 2))
        share = (np.arange(columns) + rng.random()) / columns
        for z in 0.2 + (np.arange(rows) + 0.5) / rows * (size[2] - 0.2):
            parts.append(np.column_stack([a + share[:, None] * (b - a), np.full(columns, z)]))
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    return points + rng.normal(scale=0.01, size=points.shape)


@cache
def tracked() -> list[Track]:
    rng = np.random.default_rng(1)
    times = np.linspace(0, (SWEEPS - 1) * PERIOD_S, SWEEPS)
    scanner = np.column_stack([EGO_MPS * times, np.zeros(SWEEPS), np.full(SWEEPS, 1.8)])
    path = Trajectory(times, scanner)
    parked = np.array([15.0, -6.0, 0.0, 0.0])
    moving, still, ground = [], [], []
    for k, time in enumerate(times):
        for name, (_, size, *_) in ACTORS.items():
            points = returns(size, pose(name, time), scanner[k, :2], rng)
            moving.append(np.column_stack([points, np.full(len(points), time)]))
        points = returns((4.3, 1.8, 1.5), parked, scanner[k, :2], rng)
        still.append(np.column_stack([points, np.full(len(points), time)]))
        road = np.column_stack([rng.uniform([-20, -15], [70, 15], (3000, 2)), rng.normal(scale=0.02, size=3000)])
        ground.append(np.column_stack([road, np.full(3000, time)]))
    rows = np.concatenate([*still, *ground])
    vehicles = sum(len(part) for part in still)
    classes = np.where(np.arange(len(rows)) < vehicles, CODE["vehicle"], CODE["road"]).astype(np.uint8)
    cloud = cloud_of(rows, classes)
    moved = np.concatenate(moving)
    found = Candidate(parked[:2], 0.03, 4.2, 1.7, "car", False)
    tracks, _ = assemble(cloud, cloud_of(moved, np.full(len(moved), CODE["vehicle"], np.uint8)), path, [found])
    return tracks


def cloud_of(rows: F64, classes: np.ndarray) -> PointCloud:
    rgb = np.full((len(rows), 3), (200, 20, 30), np.uint8)
    normals = np.zeros((len(rows), 3), np.float32)
    return PointCloud(Frame(), rows[:, :3].astype(np.float32), rgb, normals, classes, rows[:, 3])


@pytest.mark.parametrize("name", list(ACTORS))
def test_road_users_are_tracked(name: str) -> None:
    category, size, *_ = ACTORS[name]
    middle = SWEEPS * PERIOD_S / 2
    (track,) = (
        one for one in tracked()
        if one.moving and one.category != "ego" and np.hypot(*(one.at([middle])[0, :2] - pose(name, middle)[:2])) < 1
    )  # fmt: skip
    assert track.category == category
    true = np.array([pose(name, time) for time in track.times])
    error = np.hypot(*(track.poses[:, :2] - true[:, :2]).T)
    assert len(track.times) >= SWEEPS - 4
    assert np.median(error) < 0.15 and error.max() < 0.5
    turn = np.abs((track.poses[:, 3] - true[:, 3] + np.pi) % (2 * np.pi) - np.pi)
    assert np.degrees(np.median(turn)) < 3
    assert np.abs(track.poses[:, 2]).max() < 0.1
    assert (error < 4 * track.sigma[:, 0]).mean() > 0.9
    np.testing.assert_allclose(track.size, size, atol=0.35)
    assert track.colour == (200, 20, 30)


def test_only_actors_move_and_the_parked_car_has_one_box() -> None:
    tracks = tracked()
    assert sum(track.moving for track in tracks) == 1 + len(ACTORS)
    (still,) = (track for track in tracks if not track.moving)
    assert still.category == "car"
    assert np.ptp(still.poses, axis=0).max() == 0
    assert np.hypot(*(still.poses[0, :2] - [15, -6])) < 0.15


def test_recording_vehicle_has_a_track() -> None:
    ego = tracked()[0]
    assert ego.category == "ego" and ego.moving
    np.testing.assert_allclose(ego.poses[:, 3], 0, atol=1e-6)
    np.testing.assert_allclose(ego.speeds(), EGO_MPS, rtol=0.01)


def test_actors_never_overlap() -> None:
    tracks = tracked()
    assert all(overlaps.deepest(a, b) <= 0 for i, a in enumerate(tracks) for b in tracks[:i])


def test_boxes_that_overlap_slightly_are_narrowed_and_duplicates_dropped() -> None:
    one = Track(0, "car", (4.2, 1.8, 1.5), np.array([0.0]), np.array([[0.0, 0, 0, 0]]), np.zeros((1, 2)), False, None)
    beside = replace(one, id=1, poses=np.array([[0.0, 1.7, 0, 0]]))
    same = replace(one, id=2, poses=np.array([[0.5, 0.2, 0, 0]]))
    kept = without_overlaps([one, beside, same])
    assert [track.id for track in kept] == [0, 1]
    assert kept[1].size[1] < 1.8 and overlaps.deepest(*kept) <= 0
