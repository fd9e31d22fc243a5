"""Poses of the camera: transforms over time, odometry, and what messages of a running system may contain."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.world_camera.pose_source import PoseSource, default_origin, pose_of
from scan2sim.services.world_camera.transforms import HISTORY_NS, RESTART_NS, Transforms
from tests.services.world_camera.messages import LEVEL, odometry, tf

S = 10**9
LEFT = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""Quaternion of a turn by 90 degrees to the left."""


class Source(PoseSource):
    """A `PoseSource` that keeps its warnings; its clock stands at 1000 s."""

    def __init__(self, fixed: str = "world", *, origin: Any = None, mount: Any = None, axes: Any = "auto") -> None:
        self.warnings: list[tuple[str, str]] = []
        super().__init__(
            fixed, np.eye(4) if origin is None else origin, np.eye(4) if mount is None else mount, axes,
            warn=lambda kind, text: self.warnings.append((kind, text)), clock=lambda: 1000 * S,
        )  # fmt: skip

    def tf(self, *links: Any) -> None:
        self.receive_tf(tf(*links), static=False)

    def tf_static(self, *links: Any) -> None:
        self.receive_tf(tf(*links), static=True)


def moved(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def position(T: np.ndarray | None) -> list[float]:
    assert T is not None
    return T[:3, 3].round(6).tolist()


def test_pose_is_that_of_the_chain_interpolated() -> None:
    source = Source()
    source.tf_static(("world", "odom", 0, (10, 0, 0), LEFT), ("base", "cam_optical_frame", 0, (0, 0, 1), LEVEL))
    source.tf(("odom", "base", 1, (0, 0, 0), LEVEL))
    source.tf(("odom", "base", 2, (4, 0, 0), LEFT))
    assert source.newest("cam_optical_frame") == 2 * S
    T = source.at("cam_optical_frame", 5 * S // 4)
    assert position(T) == [10, 1, 1]
    turned = math.radians(90 + 90 / 4)
    assert T is not None and np.allclose(T[:3, 0], [math.cos(turned), math.sin(turned), 0])
    assert source.at("cam_optical_frame", 3 * S) is None and source.at("cam_optical_frame", S // 2) is None


def test_frames_of_bodies_look_along_x_and_optical_ones_along_z() -> None:
    for frame, ahead in (("camera_link", [1, 0, 0]), ("camera_optical_frame", [0, 0, 1])):
        source = Source()
        source.tf_static(("world", frame, 0, (0, 0, 0), LEVEL))
        T = source.at(frame, 0)
        assert T is not None and np.allclose(T[:3, 2], ahead)
    source = Source(axes="optical")
    source.tf_static(("world", "camera_link", 0, (0, 0, 0), LEVEL))
    T = source.at("camera_link", 0)
    assert T is not None and np.allclose(T, np.eye(4))


def test_fixed_frame_may_be_beside_the_robot_in_the_tree() -> None:
    source = Source("map")
    source.tf_static(("world", "map", 0, (3, 0, 0), LEVEL), ("world", "odom", 0, (0, 0, 0), LEVEL))
    source.tf(("odom", "base", 1, (1, 0, 0), LEVEL))
    assert position(source.at("base", S)) == [-2, 0, 0]


def test_a_camera_that_does_not_move_has_a_pose_at_any_time() -> None:
    source = Source()
    source.tf_static(("world", "camera", 0, (1, 2, 3), LEVEL))
    assert source.newest("camera") is None and position(source.at("camera", 123 * S)) == [1, 2, 3]


def test_odometry_with_mount_and_origin() -> None:
    origin, mount = pose_of((100, 0, 0, 0, 0, 90)), pose_of((0.5, 0, 1.2, 0, 10, 0))
    source = Source("", origin=origin, mount=mount)
    assert source.missing("any") == "no odometry has arrived"
    source.receive_odometry(odometry(1, (2, 0, 0)))
    source.receive_odometry(odometry(2, (4, 0, 0)))
    assert source.missing("any") is None and source.newest("any") == 2 * S
    T = source.at("any", 3 * S // 2)
    assert position(T) == [100, 3.5, 1.2]
    pitch = math.radians(10)  # positive: down (REP 103)
    assert T is not None and np.allclose(T[:3, 2], [0, math.cos(pitch), -math.sin(pitch)])


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (0, 0, math.inf, 1)])
def test_invalid_quaternion_is_reported_and_ignored(quaternion: tuple[float, ...]) -> None:
    source = Source()
    source.tf(("world", "base", 1, (1, 0, 0), LEVEL), ("base", "arm", 1, (0, 0, 0), quaternion))
    source.tf(("world", "base", 2, (9, 9, 9), quaternion), ("base", "cam", 2, (0, 0, 1), LEVEL))
    source.tf(("world", "base", 3, (3, 0, 0), LEVEL))
    assert position(source.at("base", 2 * S)) == [2, 0, 0], "other transforms of the message and of the frame remain"
    assert [kind for kind, _ in source.warnings] == ["pose", "pose"] and "'arm'" in source.warnings[0][1]
    by_odometry = Source("")
    by_odometry.receive_odometry(odometry(1, (1, 0, 0), quaternion))
    assert by_odometry.missing("") and by_odometry.warnings


def test_positions_beyond_any_world_are_reported_and_ignored() -> None:
    source = Source()
    source.tf(("world", "base", 1, (1e300, 0, 0), LEVEL))
    source.tf(("world", "base", 1, (math.nan, 0, 0), LEVEL))
    assert source.missing("base") and len(source.warnings) == 2


def test_late_poses_leave_the_history() -> None:
    transforms = Transforms()
    for k in range(100, 200):
        transforms.add("world", "base", k * S // 10, moved(k))
    for late in (3 * S, -5 * S, 150 * S // 10 + 1, *range(110 * S // 10 + 1, 111 * S // 10, S // 100)):
        transforms.add("world", "base", late, moved(-7.0))
    transforms.add("world", "base", 20 * S, moved(200))
    assert transforms.newest("world", "base") == 20 * S
    for k in (112, 150, 190):
        assert position(transforms.at("world", "base", k * S // 10)) == [k, 0, 0]
    assert position(transforms.at("world", "base", 150 * S // 10 + 1)) == [-7, 0, 0], "it is sorted in"
    assert transforms.at("world", "base", 3 * S) is None, "it was too old"


def test_history_is_bounded() -> None:
    transforms = Transforms()
    for k in range(3000):
        transforms.add("world", "base", k * S // 100, moved(k))
    newest = 2999 * S // 100
    assert transforms.at("world", "base", newest - HISTORY_NS) is not None
    assert transforms.at("world", "base", newest - HISTORY_NS - S) is None


@pytest.mark.parametrize("last", [8, 1000])
def test_simulation_that_begins_again_replaces_the_history(last: int) -> None:
    now, transforms = 0, Transforms(clock=lambda: now)
    for k in range(10 * last - 20, 10 * last):
        transforms.add("world", "base", k * S // 10, moved(k))
    for k in range(12):
        assert transforms.newest("world", "base") == (10 * last - 1 if now <= RESTART_NS else k - 1) * S // 10
        transforms.add("world", "base", k * S // 10, moved(-k))
        now += S // 10
    assert position(transforms.at("world", "base", S // 10)) == [-1, 0, 0]
    assert transforms.at("world", "base", last * S - S // 10) is None


def test_missing_pose_names_the_frames() -> None:
    source = Source()
    source.tf(("odom", "base", 1, (0, 0, 0), LEVEL))
    missing = source.missing("base")
    assert missing is not None and "--fixed-frame" in missing and "base, odom" in missing
    source.tf(("base", "odom", 1, (0, 0, 0), LEVEL))  # a loop
    assert source.missing("base") is not None


def test_messages_without_a_time_have_that_of_their_arrival() -> None:
    source = Source("")
    source.receive_odometry(odometry(0, (1, 0, 0)))
    assert source.newest("") == 1000 * S


def write_metadata(folder: Path, **content: Any) -> Path:
    (folder / "metadata.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def test_default_origin_is_where_the_robot_starts(tmp_path: Path) -> None:
    start = {"position_m": [1.0, 2.0, 0.5], "angles_rad": [0.0, 0.0, math.pi / 2], "on": "road"}
    world = write_metadata(tmp_path, spawn=start)
    for frame in ("odom", "/odom", ""):
        T = default_origin(world, frame)
        assert position(T) == [1, 2, 0.5] and np.allclose(T[:3, 0], [0, 1, 0])
    assert np.array_equal(default_origin(world, "world"), np.eye(4))
    robot = {**start, "position_m": [7.0, 0.0, 0.0]}
    assert position(default_origin(write_metadata(tmp_path, spawn=start, robot=robot), "odom")) == [7, 0, 0]


def test_default_origin_of_a_map_is_its_transform(tmp_path: Path) -> None:
    T = pose_of((5, 6, 7, 0, 0, 30))
    assert np.allclose(default_origin(write_metadata(tmp_path, T_world_map=T.tolist()), "map"), T)
    assert np.array_equal(default_origin(write_metadata(tmp_path, name="street"), "map"), np.eye(4))


def test_world_without_a_start_needs_an_origin(tmp_path: Path) -> None:
    for content in ({"name": "street"}, {"spawn": {"position_m": [1]}}, {"spawn": 5}):
        with pytest.raises(InputError, match="--origin"):
            default_origin(write_metadata(tmp_path, **content), "odom")
    (tmp_path / "metadata.json").unlink()
    assert np.array_equal(default_origin(tmp_path, "world"), np.eye(4))
