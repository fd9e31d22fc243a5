"""Global adjustment: kept only if held-out observations fit better."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.global_map import global_adjustment as module
from scan2sim.slam.global_map.global_adjustment import adjust
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import sparse_points
from scan2sim.slam.mapping.cross_validation import compare_paths
from scan2sim.slam.mapping.local_map import HELD_OUT_EVERY
from tests.fakes.slam_drive import PerspectiveFollower, ate, drive, run, scatter

pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def winding_drive() -> tuple[MapCheckpoint, np.ndarray]:
    """Map checkpoint of a drive with a perspective camera, and true positions."""
    times, poses = drive(6, turn=0.15)
    found = run(times, PerspectiveFollower(poses, scatter(poses, 12000, 1), seed=1), keep=True, parallax=1.0)
    return MapCheckpoint.of(found, []), poses[:, :3, 3]


def error(mapped: MapCheckpoint, truth: np.ndarray) -> float:
    return ate(np.stack([mapped.pose_of(p)[:3, 3] for p in mapped.placed]), truth)


def bend(mapped: MapCheckpoint) -> np.ndarray:
    """Poses of the keyframes with a slowly increasing heading error."""
    poses = mapped.map.poses(list(range(len(mapped.map.keyframes))))
    for k, pose in enumerate(poses):
        pose[:3, :3] = exp_so3([0, 1e-4 * k, 0]) @ pose[:3, :3]
    return poses


def test_held_out_observations_identify_the_better_path(
    winding_drive: tuple[MapCheckpoint, np.ndarray],
) -> None:
    mapped, _ = winding_drive
    good, bent = mapped.map.poses(list(range(len(mapped.map.keyframes)))), bend(mapped)
    assert (sparse_points(mapped).ids % HELD_OUT_EVERY > 0).all()
    assert (
        compare_paths(mapped.map, bent, good).second_is_better
        and not compare_paths(mapped.map, good, bent).second_is_better
    )
    assert compare_paths(mapped.map, good, bent).held_out > 20


def test_drifted_path_is_adjusted(winding_drive: tuple[MapCheckpoint, np.ndarray]) -> None:
    mapped, truth = winding_drive
    straight = [keyframe.T_world_cam for keyframe in mapped.map.keyframes]
    for keyframe, pose in zip(mapped.map.keyframes, bend(mapped), strict=True):
        keyframe.T_world_cam = pose
    before = error(mapped, truth)
    metrics = adjust(mapped)
    after = error(mapped, truth)
    for keyframe, pose in zip(mapped.map.keyframes, straight, strict=True):
        keyframe.T_world_cam = pose
    assert metrics["adjustment_kept"] and metrics["held_out_gain"] > 0
    assert after < before


def test_worse_adjustment_is_rejected(
    winding_drive: tuple[MapCheckpoint, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped, _ = winding_drive
    before, points = mapped.map.poses(list(range(len(mapped.map.keyframes)))), sparse_points(mapped)
    wrong = module.Adjusted(points, bend(mapped), points.xyz + 1, 0.2, 0.1)
    monkeypatch.setattr(module, "bundle_adjust", lambda _: wrong)
    metrics = adjust(mapped)
    assert not metrics["adjustment_kept"] and metrics["held_out_gain"] < 0
    assert np.array_equal(mapped.map.poses(list(range(len(before)))), before)
    assert np.array_equal(sparse_points(mapped).xyz, points.xyz)
