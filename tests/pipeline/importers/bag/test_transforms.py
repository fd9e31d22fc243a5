"""Chains of frames, static and moving, and errors that name the frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.bag.transforms import Frames, Series


def pose(x: float, degrees: float = 0.0) -> F64:
    T = np.eye(4)
    T[:3, :3], T[0, 3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix(), x
    return T


def moving(*samples: tuple[float, float]) -> Series:
    series = Series()
    for time, x in samples:
        series.add(time, pose(x))
    return series


def test_static_transforms_are_chained_through_common_ancestors() -> None:
    frames = Frames(Path("drive.mcap"), {("base", "a"): pose(1, 90), ("a", "lidar"): pose(2), ("base", "cam"): pose(5)})
    T = frames.between("cam", "lidar")
    assert np.allclose(T, np.linalg.inv(pose(5)) @ pose(1, 90) @ pose(2))
    assert np.allclose(frames.between("lidar", "cam"), np.linalg.inv(T))


def test_missing_transform_is_reported_with_its_frames_and_can_be_given() -> None:
    frames = Frames(Path("drive.mcap"), {("base", "lidar"): pose(1)}, {("odom", "base"): moving((0, 0))})
    with pytest.raises(InputError, match=r"'cam' and 'lidar'.*base > lidar, odom > base \(moving\).*--transform"):
        frames.between("cam", "lidar")
    frames.add_given(["base cam 5 0 0 0 0 0 1"])
    assert np.allclose(frames.between("cam", "lidar"), pose(-4))
    for text in ("base cam 1 2 3", "base cam 1 2 3 0 0 0 0", "base cam 1 2 3 0 0 0 45", "base cam 1 2 3 a b c d"):
        with pytest.raises(SettingError, match="is not a transform"):
            frames.add_given([text])


@pytest.mark.parametrize(
    "links",
    [
        {("lidar", "cam"): pose(9)},
        {("cam", "lidar"): pose(9)},
        {("base", "lidar"): pose(1), ("base", "cam"): pose(9)},
        {("base", "lidar"): pose(1), ("base", "rig"): pose(0), ("rig", "cam"): pose(9), ("lidar", "cam"): pose(9)},
    ],
)
def test_given_transform_replaces_that_of_the_bag_however_it_is_connected(links: dict[tuple[str, str], F64]) -> None:
    frames = Frames(Path("drive.mcap"), {**links, ("cam", "optical"): pose(0.5)})
    (warning,) = frames.add_given(["lidar cam 3 0 0 0 0 0 1"])
    assert "lidar > cam of --transform differs by" in warning and "which isn't used" in warning
    assert np.allclose(frames.between("lidar", "cam"), pose(3))
    assert np.allclose(frames.between("lidar", "optical"), pose(3.5))
    assert frames.add_given(["lidar cam 3 0 0 0 0 0 1"]) == []
    assert ("base", "lidar") not in links or frames.connected("base", "lidar")


def test_poses_are_chained_from_moving_transforms() -> None:
    frames = Frames(Path("drive.mcap"), {("base", "lidar"): pose(0.5)})
    frames.moving["map", "odom"] = moving((1.0, 100.0), (3.0, 102.0))  # rare corrections, constant before and after
    frames.moving["odom", "base"] = moving((3.5, 35.0), (0.5, 5.0), (1.0, 10.0), (2.0, 20.0), (2.0, 21.0))
    assert frames.world_frame("lidar") == "map" and frames.world_frame("lidar", "/odom") == "odom"
    times, T = frames.poses_of("lidar", "map")
    assert times.tolist() == [0.5, 1.0, 2.0, 3.5]
    assert np.allclose(T[:, 0, 3], [105.5, 110.5, 122.5, 137.5])  # the last of two poses at 2.0 s counts
    assert np.allclose(frames.poses_of("lidar", "odom")[1][:, 0, 3], [5.5, 10.5, 21.5, 35.5])


def test_poses_are_not_held_while_a_link_is_missing() -> None:
    frames = Frames(Path("drive.mcap"), {("base", "lidar"): pose(0)})
    frames.moving["map", "odom"] = moving(*((0.05 * k, 0.0) for k in range(400)))  # goes on, as localizers do
    frames.moving["odom", "base"] = moving(*((0.1 * k, float(k)) for k in range(150) if k < 40 or k > 90))
    times, T = frames.poses_of("lidar", "map")
    assert not ((times > 3.95) & (times < 9.05)).any() and times[-1] < 17.0
    assert np.allclose(T[:, 0, 3], np.minimum(10 * times, 149))
    frames.moving["map", "odom"] = moving((0.0, 0.0), (14.9, 0.5))  # rare corrections don't count as gaps
    assert len(frames.poses_of("lidar", "map")[0]) == 99


def test_world_frame_needs_a_moving_transform() -> None:
    frames = Frames(Path("drive.mcap"), {("map", "base"): pose(0), ("base", "lidar"): pose(1)})
    assert frames.world_frame("lidar") is None
    with pytest.raises(InputError, match="no moving transform from 'map' to 'lidar'"):
        frames.world_frame("lidar", "map")
    frames.moving["rig", "map"] = moving((0, 0))
    frames.static["base", "rig"] = pose(0)  # a loop of transforms must not cause an endless loop
    assert frames.world_frame("lidar") is not None
