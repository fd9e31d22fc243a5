"""What drivers publish that isn't what it looks like: it is refused, left out with a reason, or read as it is meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.bag.contents import inspected
from scan2sim.pipeline.importers.bag.plan import BagParams, Plan, described, plan_import
from scan2sim.pipeline.importers.bag.reader import opened
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.rig import read_rig
from scan2sim.pipeline.io.sweep_files import list_files
from tests.fakes.bags import BagFile, records
from tests.pipeline.importers.bag.test_unpack import (
    CAMERA,
    OFFSETS,
    START,
    SWEEPS,
    T_BASE_LIDAR,
    XYZ,
    Writer,
    base,
    camera,
    gnss,
    odometry,
    photo,
    points,
    tf,
    unpacked,
    write,
)

EARTH = np.array([4.2e6, 0.7e6, 4.75e6])


def planned(path: Path, **params: Any) -> Plan:
    """The plan of a bag's import."""
    with opened(path) as bag:
        return plan_import(inspected(bag), BagParams(**params))


def uses_of(path: Path) -> dict[str, str]:
    """Use of each topic of a bag that can be imported."""
    with opened(path) as bag:
        uses, _, error = described(inspected(bag), BagParams())
    assert error is None
    return uses


def moved(k: int, origin: F64) -> F64:
    T = base(k)
    T[:3, 3] += origin
    return T


def tai(bag: BagFile, k: int, time: float) -> None:
    """A lidar whose clock is TAI: PTP without the offset to UTC."""
    bag.cloud("/points", time + 37, "lidar", records(XYZ, time=OFFSETS), log_s=time)


def test_sweeps_and_poses_of_two_clocks_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "mcap", tf, tai)
    with pytest.raises(InputError, match=r"map > base are 37\.0 s before those of /points.*--stamps log"):
        unpacked(path, tmp_path / "a")
    found, _ = unpacked(path, tmp_path / "b", stamps="log")
    assert list_files(found.sweeps)[2].stem == "1700000000.200000000"


@pytest.mark.parametrize("old", [SWEEPS, 1])
def test_second_lidar_since_its_start_is_refused_unless_only_its_first_message_is_old(tmp_path: Path, old: int) -> None:
    def second(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/second", time - 5 if k < old else time, "camera", records(XYZ, time=OFFSETS), log_s=time)

    path = write(tmp_path / "bag", "mcap", tf, points, second)
    if old == 1:
        assert len(planned(path).lidars) == 2
    else:
        with pytest.raises(InputError, match=r"two clocks: those of /second are 5\.0 s before those of /points"):
            planned(path)


@pytest.mark.parametrize(("delay", "reported"), [(0.01, True), (0.12, False)])
def test_points_that_are_later_than_their_recording_are_reported(tmp_path: Path, delay: float, reported: bool) -> None:
    def late(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/points", time, "lidar", records(XYZ, time=OFFSETS), log_s=time + delay)

    _, notes = unpacked(write(tmp_path / "bag", "mcap", tf, late), tmp_path / "out")
    assert [("0.09 s later than the recording" in note) for note in notes] == [True] * reported


def raw_imu(bag: BagFile, k: int, time: float) -> None:
    """The IMU of a lidar under ROS 2: the driver leaves the orientation at the default of the message."""
    for i in range(5):
        t = time + 0.02 * i
        bag.write(
            "/livox/imu", "sensor_msgs/Imu", t, header=bag.header(t, "lidar"), orientation={"w": 1.0},
            angular_velocity={"x": 0.01, "z": 0.1},
        )  # fmt: skip


def test_imu_without_orientation_gives_no_poses(tmp_path: Path) -> None:
    assert planned(write(tmp_path / "a", "mcap", gnss, raw_imu, points)).poses.imu == "/imu"

    def fix(bag: BagFile, k: int, time: float) -> None:
        bag.fix("/fix", time, "antenna", (48.0, 11.0 + 1e-5 * k, 500.0), sigma=0.02)

    path = write(tmp_path / "b", "mcap", fix, raw_imu, points)
    assert planned(path).poses.kind == "sweeps" and uses_of(path)["/livox/imu"] == "not used: has no orientations"


def test_heading_of_another_convention_is_reported(tmp_path: Path) -> None:
    def north(bag: BagFile, k: int, time: float) -> None:
        gnss(bag, k, time, wrong_deg=90)

    _, notes = unpacked(write(tmp_path / "bag", "mcap", north, points, sweeps=12), tmp_path / "out")
    assert len(notes) == 1 and "degrees off the direction of travel: it must be in east, north, up" in notes[0]


def test_fixes_without_covariance_are_used_with_a_warning(tmp_path: Path) -> None:
    def unknown(bag: BagFile, k: int, time: float) -> None:
        gnss(bag, k, time, sigma=None)

    plan = planned(write(tmp_path / "bag", "mcap", unknown, points))
    assert plan.poses.kind == "gnss" and "/fix has no covariances" in plan.warnings[0]


def test_receiver_with_valid_and_exact_fixes_is_chosen(tmp_path: Path) -> None:
    def others(bag: BagFile, k: int, time: float) -> None:
        for i in range(3):
            bag.fix("/gps/phone", time + 0.02 * i, "antenna", (48.7, 12.96, 100), sigma=4.0)
            bag.fix("/gps/none", time + 0.02 * i, "antenna", (np.nan, np.nan, np.nan), sigma=0.01)

    assert planned(write(tmp_path / "bag", "mcap", gnss, others, points)).poses.topic == "/fix"


def test_receiver_and_imu_that_start_late_are_used(tmp_path: Path) -> None:
    def late(bag: BagFile, k: int, time: float) -> None:
        if k >= 60:
            gnss(bag, k // 10, time)
            return
        bag.fix("/fix", time, "antenna", (np.nan, np.nan, np.nan))
        unknown = dict.fromkeys("xyzw", np.nan)
        bag.write("/imu", "sensor_msgs/Imu", time, header=bag.header(time, "base"), orientation=unknown)
        if k == 0:
            bag.transforms("/tf_static", time, [("base", "antenna", np.eye(4), time)])

    plan = planned(write(tmp_path / "bag", "mcap", late, points, sweeps=120))
    assert (plan.poses.kind, plan.warnings) == ("gnss", ())


def test_gap_of_fixes_is_not_bridged_by_a_straight_line(tmp_path: Path) -> None:
    def tunnel(bag: BagFile, k: int, time: float) -> None:
        if 20 <= k < 60:
            bag.imu("/imu", time, "base", base(k // 10)[:3, :3])
        else:
            gnss(bag, k // 10, time)

    found, notes = unpacked(write(tmp_path / "bag", "mcap", tunnel, points, sweeps=80), tmp_path / "out")
    assert found.poses is not None
    times = trajectory_io.read(found.poses).times - START
    assert not ((times > 1.95) & (times < 5.95)).any() and len(times) == 40
    assert any("50 % of the drive have no valid fixes or orientations" in note for note in notes)


def earth(bag: BagFile, k: int, time: float) -> None:
    bag.odometry("/odometry_ecef", time, ("FP_ECEF", "base"), moved(k, EARTH))


def test_earth_centred_odometry_is_not_used(tmp_path: Path) -> None:
    def local(bag: BagFile, k: int, time: float) -> None:
        bag.odometry("/odometry_enu", time, ("FP_ENU0", "base"), base(k))

    path = write(tmp_path / "bag", "mcap", earth, local, points)
    assert planned(path).poses.topic == "/odometry_enu" and "earth-centred" in uses_of(path)["/odometry_ecef"]
    with pytest.raises(InputError, match="earth-centred frame .ECEF., whose z axis isn't up, in /odometry_ecef"):
        unpacked(path, tmp_path / "out", poses="/odometry_ecef")


def test_earth_centred_transforms_are_not_used(tmp_path: Path) -> None:
    def ecef_tf(bag: BagFile, k: int, time: float) -> None:
        bag.transforms("/tf", time, [("FP_ECEF", "base", moved(k, EARTH), time)])

    path = write(tmp_path / "bag", "mcap", ecef_tf, odometry, points)
    plan = planned(path)
    assert plan.poses.topic == "/odom" and "its frame 'FP_ECEF' is earth-centred" in plan.warnings[0]
    with pytest.raises(InputError, match="in the frame 'FP_ECEF'"):
        unpacked(path, tmp_path / "out", poses="tf")


def test_odometry_of_positions_alone_is_not_used(tmp_path: Path) -> None:
    def positions(bag: BagFile, k: int, time: float) -> None:
        T = np.eye(4)
        T[:3, 3] = base(k)[:3, 3]
        bag.odometry("/odometry/gps", time, ("map", "base"), T)

    path = write(tmp_path / "bag", "mcap", positions, odometry, points)
    assert planned(path).poses.topic == "/odom"
    with pytest.raises(InputError, match="positions without orientations in /odometry/gps"):
        unpacked(path, tmp_path / "out", poses="/odometry/gps")


def test_depth_images_are_recognized_when_compressed(tmp_path: Path) -> None:
    png = cv2.imencode(".png", np.full((30, 40), 1500, np.uint16))[1].tobytes()

    def depth(bag: BagFile, k: int, time: float) -> None:
        bag.camera_info("/depth/camera_info", time, "camera", CAMERA)
        bag.compressed("/depth/image/compressed", time, "camera", png, "16UC1; png compressed ")
        bag.compressed("/depth/packed", time, "camera", bytes(12) + png, "16UC1; compressedDepth png")

    uses = uses_of(write(tmp_path / "bag", "mcap", tf, camera, depth, points))
    assert uses["/depth/image/compressed"] == uses["/depth/packed"] == "not used: depth images"
    assert uses["/front/image_raw"].startswith("photos")


@pytest.mark.parametrize(("bits", "warned"), [(12, True), (16, False)])
def test_images_of_12_bits_in_16_are_reported_as_dark(tmp_path: Path, bits: int, warned: bool) -> None:
    def grey(bag: BagFile, k: int, time: float) -> None:
        bag.image("/front/image_raw", time, "camera", photo(k)[..., 0].astype(np.uint16) << (bits - 8), "mono16")
        bag.camera_info("/front/camera_info", time, "camera", CAMERA)

    warnings = planned(write(tmp_path / "bag", "mcap", tf, grey, points)).warnings
    assert [("uses 12 of 16 bits" in text) for text in warnings] == [True] * warned


def test_one_topic_of_each_camera_is_used(tmp_path: Path) -> None:
    """A stereo camera publishes its left images twice, and both in the frame of the left camera; and infrared ones."""

    def stereo(bag: BagFile, k: int, time: float) -> None:
        for name, offset in (("a_right", -4.2), ("left", 0.0), ("rgb", 0.0)):
            bag.image(f"/zed/{name}/image_rect", time, "camera", photo(k), "rgb8")
            K = np.array([35.0, 0, 19, 0, 36, 14, 0, 0, 1])
            P = np.array([35.0, 0, 19, offset, 0, 36, 14, 0, 0, 0, 1, 0])
            bag.write(
                f"/zed/{name}/camera_info", "sensor_msgs/CameraInfo", time, header=bag.header(time, "camera"),
                height=30, width=40, distortion_model="plumb_bob", d=np.zeros(5), k=K, r=np.eye(3).ravel(), p=P,
            )  # fmt: skip
        bag.image("/d435/infra1/image_rect_raw", time, "lidar", photo(k)[..., 0], "mono8")
        bag.camera_info("/d435/infra1/camera_info", time, "lidar", CAMERA)

    path = write(tmp_path / "bag", "mcap", tf, stereo, points)
    assert [source.topic for source in planned(path).cameras] == ["/zed/left/image_rect"]
    uses = uses_of(path)
    assert "of the same camera as /zed/left/image_rect" in uses["/zed/a_right/image_rect"]
    assert "infrared" in uses["/d435/infra1/image_rect_raw"]


def test_clouds_that_are_no_sweeps_of_a_lidar_are_left_out(tmp_path: Path) -> None:
    def others(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/concatenated", time, "base_link", records(np.concatenate([XYZ, XYZ[:30]])))
        bag.cloud("/front_radar/points", time, "camera", records(XYZ[:5], rcs=np.ones(5, np.float32)))
        rgb = np.ones(len(XYZ) * 20, np.float32)
        bag.cloud("/d435/color/points", time, "optical", records(np.repeat(XYZ, 20, axis=0), rgb=rgb))
        if k == 0:
            for child in ("base_link", "optical"):
                bag.transforms("/tf_static", time, [("base", child, np.eye(4), time)])

    path = write(tmp_path / "bag", "mcap", tf, points, others)
    uses = uses_of(path)
    assert [lidar.topic for lidar in planned(path).lidars] == ["/points"]
    assert "the points of /points in the vehicle's frame" in uses["/concatenated"]
    assert "a radar" in uses["/front_radar/points"] and "a depth camera" in uses["/d435/color/points"]


def test_whole_sweeps_are_preferred_to_their_segments(tmp_path: Path) -> None:
    def segments(bag: BagFile, k: int, time: float) -> None:
        for i in range(6):
            part = slice(10 * i, 10 * i + 10)
            bag.cloud("/a_segments", time + 0.016 * i, "lidar", records(XYZ[part], time=OFFSETS[part]))

    assert planned(write(tmp_path / "bag", "mcap", tf, segments, points)).lidars[0].topic == "/points"


def test_sweeps_in_the_frame_of_a_vehicle_with_moving_wheels_are_used(tmp_path: Path) -> None:
    def vehicle(bag: BagFile, k: int, time: float) -> None:
        links = [("odom", "base_link", base(k), time), ("base_link", "wheel", moved(k, np.zeros(3)), time)]
        bag.transforms("/tf", time, links)
        bag.cloud("/points", time, "base_link", records(XYZ, time=OFFSETS))

    plan = planned(write(tmp_path / "bag", "mcap", vehicle))
    assert plan.lidars[0].frame == "base_link" and plan.poses.world == "odom"


def test_topic_replaces_an_empty_frame(tmp_path: Path) -> None:
    def unnamed(bag: BagFile, k: int, time: float) -> None:
        bag.image("/front/image_raw", time, "", photo(k), "rgb8")
        bag.camera_info("/front/camera_info", time, "", CAMERA)

    path = write(tmp_path / "bag", "mcap", tf, unnamed, points)
    with pytest.raises(InputError, match="between the frames 'front/image_raw' and 'lidar'"):
        unpacked(path, tmp_path / "a")
    found, _ = unpacked(path, tmp_path / "b", transform=("lidar front/image_raw 0 0 1 0 0 0 1",))
    assert found.photos is not None and read_rig(found.photos)[0].T_camera_scanner[2, 3] == -1


def two_odometries(bag: BagFile, k: int, time: float) -> None:
    shifted = moved(k, np.array([100.0, 0, 0]))
    bag.transforms("/tf", time, [("odom", "base", base(k), time), ("camera_init", "base", shifted, time)])


@pytest.mark.parametrize(("given", "used", "other"), [(None, "odom", "camera_init"), ("camera_init",) * 2 + ("odom",)])
def test_one_of_two_parents_is_used_and_named(tmp_path: Path, given: str | None, used: str, other: str) -> None:
    writers: tuple[Writer, ...] = (two_odometries, points)
    found, notes = unpacked(write(tmp_path / "bag", "mcap", *writers), tmp_path / "out", world_frame=given)
    assert notes == [f"'base' has several parents in /tf: {used!r} is used, not {other!r} (--world-frame)"]
    assert found.poses is not None
    first = trajectory_io.read(found.poses).positions[0]
    assert np.allclose(first, T_BASE_LIDAR[:3, 3] + [100 if used == "camera_init" else 0, 0, 0])


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_metadata_that_a_reindex_left_incomplete_are_no_obstacle(tmp_path: Path, form: str) -> None:
    path = write(tmp_path / "bag", form)
    text = (path / "metadata.yaml").read_text(encoding="utf-8")
    assert f"storage_identifier: {form}" in text
    (path / "metadata.yaml").write_text(text.replace(f"storage_identifier: {form}", 'storage_identifier: ""'))
    assert unpacked(path, tmp_path / "out")[0].metrics["photos"] == SWEEPS


def test_messages_in_a_write_ahead_log_are_not_lost_silently(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "sqlite3")
    file = next(path.glob("*.db3"))
    file.with_name(f"{file.name}-wal").write_bytes(b"content")
    for place in (path, file):
        with pytest.raises(InputError, match="are still in .*-wal.*wal_checkpoint"), opened(place):
            pass


@pytest.mark.parametrize(("profile", "remedy"), [("", "Foxglove's own schemas"), ("ros1", "the .bag file")])
def test_mcap_files_of_other_programs_are_named(tmp_path: Path, profile: str, remedy: str) -> None:
    name, library = profile.encode(), b"other"
    record = b"".join(len(text).to_bytes(4, "little") + text for text in (name, library))
    head = b"\x89MCAP0\r\n\x01" + len(record).to_bytes(8, "little") + record
    (tmp_path / "drive.mcap").write_bytes(head + bytes(50))
    with pytest.raises(InputError, match=f"without ROS 2 messages .profile '{profile}'.*{remedy}"):
        unpacked(tmp_path / "drive.mcap", tmp_path / "out")
