"""Whether the global adjustment helps, and which path witnesses keep."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.mapping import global_adjustment as module
from scan2sim.slam.mapping.cross_validation import judge
from scan2sim.slam.mapping.global_adjustment import adjust
from scan2sim.slam.mapping.local_map import WITNESSES
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.mapping.sparse_model import kept
from tests.slam.synthetic import Narrow, ate, drive, run, scatter

pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def winding() -> tuple[Mapped, np.ndarray]:
    """What a drive of a perspective camera has left, and the truth."""
    times, poses = drive(6, turn=0.15)
    found = run(times, Narrow(poses, scatter(poses, 12000, 1), seed=1), keep=True, parallax=1.0)
    return Mapped.of(found, []), poses[:, :3, 3]


def error(mapped: Mapped, truth: np.ndarray) -> float:
    return ate(np.stack([mapped.pose_of(p)[:3, 3] for p in mapped.placed]), truth)


def bend(mapped: Mapped) -> np.ndarray:
    """The keyframes' poses, along a path that slowly turns."""
    poses = mapped.map.poses(list(range(len(mapped.map.keyframes))))
    for k, pose in enumerate(poses):
        pose[:3, :3] = exp_so3([0, 1e-4 * k, 0]) @ pose[:3, :3]
    return poses


def test_witnesses_have_no_say_in_the_map_and_know_the_better_of_two_paths(winding: tuple[Mapped, np.ndarray]) -> None:
    mapped, _ = winding
    good, bent = mapped.map.poses(list(range(len(mapped.map.keyframes)))), bend(mapped)
    assert (kept(mapped).ids % WITNESSES > 0).all()
    assert judge(mapped.map, bent, good).better and not judge(mapped.map, good, bent).better
    assert judge(mapped.map, good, bent).witnesses > 20


def test_a_path_that_drifted_is_adjusted(winding: tuple[Mapped, np.ndarray]) -> None:
    mapped, truth = winding
    straight = [keyframe.T_world_cam for keyframe in mapped.map.keyframes]
    for keyframe, pose in zip(mapped.map.keyframes, bend(mapped), strict=True):
        keyframe.T_world_cam = pose
    before = error(mapped, truth)
    facts = adjust(mapped)
    after = error(mapped, truth)
    for keyframe, pose in zip(mapped.map.keyframes, straight, strict=True):
        keyframe.T_world_cam = pose
    assert facts["adjustment_kept"] and facts["witnesses_gain"] > 0
    assert after < before


def test_an_adjustment_that_fits_worse_changes_nothing(
    winding: tuple[Mapped, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped, _ = winding
    before, points = mapped.map.poses(list(range(len(mapped.map.keyframes)))), kept(mapped)
    wrong = module.Adjusted(points, bend(mapped), points.xyz + 1, 0.2, 0.1)
    monkeypatch.setattr(module, "adjusted", lambda _: wrong)
    facts = adjust(mapped)
    assert not facts["adjustment_kept"] and facts["witnesses_gain"] < 0
    assert np.array_equal(mapped.map.poses(list(range(len(before)))), before)
    assert np.array_equal(kept(mapped).xyz, points.xyz)
