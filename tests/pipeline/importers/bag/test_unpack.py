"""Bags in all formats: sweeps, photos, calibration and poses are unpacked losslessly; errors name their cause."""

from __future__ import annotations

import errno
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import DataError, InputError, ScanError, SettingError, SpaceError, UnavailableError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.importers.bag.contents import inspected
from scan2sim.pipeline.importers.bag.plan import BagParams, described, plan_import
from scan2sim.pipeline.importers.bag.reader import is_bag, opened
from scan2sim.pipeline.importers.bag.unpack import Unpacked, unpack
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.rig import read_rig
from scan2sim.pipeline.io.sweep_files import list_files, read_sweep
from scan2sim.pipeline.io.urdf import read_fixed_joints
from tests.fakes.bags import FORMATS, BagFile, bag_file, bag_path, records
from tests.present import present

START, SWEEPS, PERIOD = 1_700_000_000.0, 8, 0.1
CAMERA = Camera("opencv", 40, 30, 35.0, 36.0, 19.0, 14.0, (-0.1, 0.02, 1e-3, 2e-3))
T_BASE_LIDAR, T_LIDAR_CAMERA = np.eye(4), np.eye(4)
T_BASE_LIDAR[:3, :3], T_BASE_LIDAR[:3, 3] = Rotation.from_euler("z", 30, degrees=True).as_matrix(), [1, 0.2, 1.8]
T_LIDAR_CAMERA[:3, :3], T_LIDAR_CAMERA[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.1, 0, -0.2]
XYZ = np.random.default_rng(0).uniform(-20, 20, (60, 3)).astype(np.float32)
OFFSETS = np.linspace(0, PERIOD, len(XYZ)).astype(np.float32)


def base(k: int) -> F64:
    """Pose of the vehicle at sweep k."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 0.1 * k).as_matrix(), [1.2 * k, 0.1 * k * k, 0]
    return T


def photo(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)


def statics(bag: BagFile) -> None:
    links = [("base", "lidar", T_BASE_LIDAR, START), ("lidar", "camera", T_LIDAR_CAMERA, START)]
    bag.transforms("/tf_static", START, links)


def tf(bag: BagFile, k: int, time: float) -> None:
    bag.transforms("/tf", time, [("map", "base", base(k), time)])


def odometry(bag: BagFile, k: int, time: float) -> None:
    bag.odometry("/odom", time, ("odom", "base"), base(k))


def camera(bag: BagFile, k: int, time: float) -> None:
    bag.image("/front/image_raw", time, "camera", photo(k), "rgb8")
    bag.camera_info("/front/camera_info", time, "camera", CAMERA)


def points(bag: BagFile, k: int, time: float) -> None:
    rows = records(XYZ + np.float32(0.1 * k), intensity=np.full(len(XYZ), 51, np.uint8), time=OFFSETS)
    bag.cloud("/points", time, "lidar", rows)


Writer = Callable[[BagFile, int, float], None]


def write(path: Path, form: str = "mcap", *writers: Writer, static: bool = True, sweeps: int = SWEEPS) -> Path:
    """Write a bag with a message of each writer per sweep; default: poses by tf, a camera, and a lidar."""
    with bag_file(path, form) as bag:
        if static:
            statics(bag)
        for k in range(sweeps):
            for writer in writers or (tf, camera, points):
                writer(bag, k, START + PERIOD * k)
    return path


def unpacked(path: Path, out: Path, **params: Any) -> tuple[Unpacked, list[str]]:
    """The files of a bag, and the warnings."""
    notes: list[str] = []
    out.mkdir(exist_ok=True)
    beside = {name: params.pop(name, None) for name in ("intrinsics", "urdf")}
    return unpack(path, out, BagParams(**params), warn=notes.append, **beside), notes


@pytest.mark.parametrize("form", FORMATS)
def test_sweeps_photos_calibration_and_poses_are_unpacked_losslessly(tmp_path: Path, form: str) -> None:
    found, notes = unpacked(write(bag_path(tmp_path, form), form), tmp_path / "out")
    files = list_files(found.sweeps)
    assert notes == [] and [file.stem for file in files] == [
        f"{1_700_000_000 + k // 10}.{k % 10}00000000" for k in range(8)
    ]
    third = read_sweep(files[3])
    assert np.array_equal(third.xyz, XYZ + np.float32(0.3)) and set(third.intensity) == {51 * 257}
    assert third.time is not None and np.allclose(third.time, START + 0.3 + OFFSETS, atol=1e-6)
    assert found.photos is not None and found.poses is not None and found.gps is None
    (one,) = read_rig(found.photos)
    assert one.camera == CAMERA and np.allclose(one.T_camera_scanner, np.linalg.inv(T_LIDAR_CAMERA))
    pictures = sorted((found.photos / one.id).iterdir())
    assert one.id == "front" and [file.stem for file in pictures] == [file.stem for file in files]
    assert np.array_equal(cv2.imread(str(pictures[5]))[..., ::-1], photo(5))
    path = trajectory_io.read(found.poses)
    assert np.allclose(path.times, START + PERIOD * np.arange(SWEEPS), atol=1e-6)
    assert np.allclose(path.poses, [base(k) @ T_BASE_LIDAR for k in range(SWEEPS)], atol=1e-6)


def test_odometry_messages_give_the_same_poses(tmp_path: Path) -> None:
    found, _ = unpacked(write(tmp_path / "bag", "mcap", odometry, points), tmp_path / "out")
    assert found.poses is not None and found.photos is None
    poses = trajectory_io.read(found.poses).poses
    assert np.allclose(poses, [base(k) @ T_BASE_LIDAR for k in range(SWEEPS)], atol=1e-6)


def stamped(kind: str) -> Callable[[BagFile, int, float], None]:
    """Writer of poses of the vehicle without the name of its frame."""

    def writer(bag: BagFile, k: int, time: float) -> None:
        q = Rotation.from_matrix(base(k)[:3, :3]).as_quat()
        pose = {
            "position": dict(zip("xyz", base(k)[:3, 3], strict=True)),
            "orientation": dict(zip("xyzw", q, strict=True)),
        }
        body = pose if kind == "PoseStamped" else {"pose": pose}
        bag.write("/pose", f"geometry_msgs/{kind}", time, header=bag.header(time, "map"), pose=body)

    return writer


@pytest.mark.parametrize("name", ["drive #3", "drive?", "drive%203"])
def test_paths_that_sqlite_would_read_as_uris_are_reported(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "drive.db3").write_bytes(b"SQLite format 3\0")
    for path in (tmp_path / name, tmp_path / name / "drive.db3"):
        with pytest.raises(InputError, match="in its path. Rename it"), opened(path):
            pass


def test_a_compressed_bag_that_is_larger_than_the_temporary_folder_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unpack_to_full_disk(reader: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rosbags.highlevel.AnyReader.open", unpack_to_full_disk)
    with pytest.raises(SpaceError, match="Set TMPDIR"), opened(write(bag_path(tmp_path, "mcap"))):
        pass


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped"])
def test_pose_topics_are_used_only_if_chosen(tmp_path: Path, kind: str, form: str) -> None:
    path = write(bag_path(tmp_path, form), form, stamped(kind), points)
    with opened(path) as bag:
        uses, *_ = described(inspected(bag), BagParams())
    assert uses["/pose"] == "not used (--poses uses it)"
    found, notes = unpacked(path, tmp_path / "out", poses="/pose")
    assert found.poses is not None and notes == ["the poses of /pose are taken to be those of 'base' (--pose-frame)"]
    assert np.allclose(
        trajectory_io.read(found.poses).poses, [base(k) @ T_BASE_LIDAR for k in range(SWEEPS)], atol=1e-6
    )
    found, notes = unpacked(path, tmp_path / "b", poses="/pose", pose_frame="lidar")
    assert found.poses is not None and notes == []
    assert np.allclose(trajectory_io.read(found.poses).poses, [base(k) for k in range(SWEEPS)], atol=1e-6)


def urdf(T_lidar_camera: F64, path: Path) -> Path:
    """A robot whose camera is fixed to the lidar by an extra link, and which has a revolute wheel joint."""
    rpy = Rotation.from_matrix(T_lidar_camera[:3, :3]).as_euler("xyz")
    origin = f'xyz="{" ".join(map(str, T_lidar_camera[:3, 3]))}" rpy="{" ".join(map(str, rpy))}"'
    path.write_text(
        f"""<?xml version="1.0"?><robot name="r"><link name="lidar"/>
        <joint name="a" type="fixed"><parent link="lidar"/><child link="mount"/></joint>
        <joint name="b" type="fixed"><parent link="mount"/><child link="camera"/><origin {origin}/></joint>
        <joint name="w" type="continuous"><parent link="base"/><child link="wheel"/></joint></robot>""",
        encoding="utf-8",
    )
    return path


def lidar_link(bag: BagFile, k: int, time: float) -> None:
    if k == 0:
        bag.transforms("/tf_static", time, [("base", "lidar", T_BASE_LIDAR, time)])


def test_fixed_joints_of_a_urdf_complete_the_transforms(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "mcap", lidar_link, tf, camera, points, static=False)
    with pytest.raises(InputError, match=r"no static transform between the frames 'camera' and 'lidar'.*--urdf"):
        unpacked(path, tmp_path / "a")
    notes: list[str] = []
    (tmp_path / "b").mkdir()
    robot = urdf(T_LIDAR_CAMERA, tmp_path / "robot.urdf")
    found = unpack(path, tmp_path / "b", BagParams(), urdf=robot, warn=notes.append)
    assert found.photos is not None and notes == []
    assert np.allclose(read_rig(found.photos)[0].T_camera_scanner, np.linalg.inv(T_LIDAR_CAMERA))
    with opened(path) as bag:
        uses, _, error = described(inspected(bag), BagParams(), robot)
    assert error is None and uses["/front/image_raw"].startswith("photos")


def test_transforms_of_the_bag_override_those_of_a_urdf(tmp_path: Path) -> None:
    robot = tmp_path / "robot.urdf"
    joint = '<joint name="a" type="fixed"><parent link="lidar"/><child link="camera"/><origin xyz="1 0 0"/></joint>'
    robot.write_text(f'<robot name="r">{joint}</robot>', encoding="utf-8")
    notes: list[str] = []
    (tmp_path / "out").mkdir()
    found = unpack(write(tmp_path / "bag"), tmp_path / "out", BagParams(), urdf=robot, warn=notes.append)
    assert found.photos is not None and notes[0].startswith("lidar > camera of robot.urdf differs by 0.922 m")
    assert np.allclose(read_rig(found.photos)[0].T_camera_scanner, np.linalg.inv(T_LIDAR_CAMERA))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot name='r'/>", "has no fixed joints"),
        ("<sdf/>", "is not a URDF file"),
        ("<robot", "is not readable XML"),
        ("<robot><joint name='j' type='fixed'><parent link='a'/></joint></robot>", "joint 'j' is invalid"),
        (
            "<robot><joint name='j' type='fixed'><parent link='a'/><child link='b'/>"
            "<origin xyz='${x} 0 0'/></joint></robot>",
            "joint 'j' is invalid.*xacro robot.urdf.xacro",
        ),
    ],
)
def test_invalid_urdf_is_rejected_with_its_cause(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.urdf").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_fixed_joints(tmp_path / "r.urdf")


def gnss(bag: BagFile, k: int, time: float, wrong_deg: float = 0.0, sigma: float | None = 0.02) -> None:
    """An antenna 2 m behind the IMU, which is the vehicle's frame; grid north is not true north."""
    from pyproj import Proj, Transformer

    place = np.array([500_000 - 150_000.0, 5_400_000, 100])
    antenna = base(k)[:3, :3] @ [-2.0, 0, 0] + base(k)[:3, 3] + place
    lon, lat = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*antenna[:2])
    bag.fix("/fix", time, "antenna", (lat, lon, antenna[2]), sigma=sigma)
    convergence = Proj("EPSG:32633").get_factors(lon, lat).meridian_convergence
    turn = Rotation.from_euler("z", wrong_deg - convergence, degrees=True)
    bag.imu("/imu", time, "base", turn.as_matrix() @ base(k)[:3, :3])
    if k == 0:
        T = np.eye(4)
        T[0, 3] = -2.0
        bag.transforms("/tf_static", time, [("base", "antenna", T, time)])


def test_gnss_and_imu_give_poses_in_utm(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "mcap", gnss, points)
    found, notes = unpacked(path, tmp_path / "out")
    assert found.metrics["poses"] == "gnss" and found.poses is not None and notes == []
    expected = np.array([base(k) @ T_BASE_LIDAR for k in range(SWEEPS)])
    expected[:, :3, 3] += [350_000.0, 5_400_000, 100]
    poses = trajectory_io.read(found.poses).poses
    assert np.abs(poses[:, :3, 3] - expected[:, :3, 3]).max() < 2e-3
    assert np.abs(poses[:, :3, :3] - expected[:, :3, :3]).max() < 1e-5
    with opened(path) as bag:
        from scan2sim.pipeline.importers.bag.poses import crs_of

        contents = inspected(bag)
        assert crs_of(contents, plan_import(contents, BagParams())) == "EPSG:32633"
    assert crs_io.utm(48.7, 12.96) == "EPSG:32633"


def poor_gps(bag: BagFile, k: int, time: float) -> None:
    bag.fix("/fix", time, "antenna", (48.0, 11.0 + 1e-5 * k, 500.0), sigma=3.0)


def test_inexact_fixes_are_fused_with_sweep_matching(tmp_path: Path) -> None:
    found, _ = unpacked(write(tmp_path / "bag", "mcap", poor_gps, points), tmp_path / "out")
    assert found.poses is None and found.gps is not None and found.metrics["poses"] == "sweeps"
    lines = found.gps.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + SWEEPS and lines[1].startswith("1700000000.000000,48.0") and lines[1].endswith("3.0000")


def test_second_lidar_is_added_to_the_sweep_nearest_in_time(tmp_path: Path) -> None:
    def second(bag: BagFile, k: int, time: float) -> None:
        bag.livox("/livox", time + 0.03, "left", np.array([[5.0, 0, 0], [0, 0, 0], [6.0, 0, 0]]), [0, 0, 50_000_000])
        if k == 0:
            T = np.eye(4)
            T[:3, 3] = [0, 2, 0]
            bag.transforms("/tf_static", time, [("lidar", "left", T, time)])

    found, notes = unpacked(write(tmp_path / "bag", "mcap", tf, points, second), tmp_path / "out")
    files = list_files(found.sweeps)
    sweep = read_sweep(files[2])
    assert notes == [] and len(files) == SWEEPS and len(sweep.xyz) == len(XYZ) + 2
    assert sweep.xyz[-2:].tolist() == [[5, 2, 0], [6, 2, 0]]
    assert sweep.time is not None and np.allclose(sweep.time[-2:], START + 0.2 + np.array([0.03, 0.08]), atol=1e-6)


def test_sweeps_of_a_second_lidar_alone_are_dropped_and_counted(tmp_path: Path) -> None:
    def lidars(bag: BagFile, k: int, time: float) -> None:
        if k < 10:
            points(bag, k, time)
        bag.cloud("/second", time, "camera", records(XYZ[:10], time=OFFSETS[:10]))

    path = write(tmp_path / "bag", "mcap", tf, lidars, sweeps=40)
    found, notes = unpacked(path, tmp_path / "out", lidar=("/points", "/second"))
    assert found.metrics["sweeps"] == 10 and found.metrics["points"] == 10 * (len(XYZ) + 10) + 5 * 10
    assert "25 sweeps of other lidars are left out: there is none of /points at their time" in notes


def test_recording_times_replace_those_of_headers(tmp_path: Path) -> None:
    def late(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/points", 0.0, "lidar", records(XYZ, time=OFFSETS), log_s=time)

    path = write(tmp_path / "bag", "mcap", tf, late)
    with pytest.raises(InputError, match=r"/points at 0\.100 s has no time stamp in its header.*--stamps log"):
        unpacked(path, tmp_path / "a")
    found, _ = unpacked(path, tmp_path / "b", stamps="log")
    third = list_files(found.sweeps)[2]
    times = read_sweep(third).time
    assert third.stem == "1700000000.200000000" and times is not None
    assert np.allclose(times, START + 0.2 + OFFSETS - PERIOD, atol=1e-6)  # it was recorded after its last point


def test_transforms_repeated_by_ros_1_are_static(tmp_path: Path) -> None:
    def repeated(bag: BagFile, k: int, time: float) -> None:
        links = [("base", "lidar", T_BASE_LIDAR, time), ("lidar", "camera", T_LIDAR_CAMERA, time)]
        bag.transforms("/tf", time, links)

    moving = write(tmp_path / "a.bag", "ros1", repeated, tf, camera, points, static=False)
    found, _ = unpacked(moving, tmp_path / "a")
    assert found.metrics["poses"] == "tf" and found.photos is not None and found.poses is not None
    assert np.allclose(read_rig(found.photos)[0].T_camera_scanner, np.linalg.inv(T_LIDAR_CAMERA))
    assert np.allclose(trajectory_io.read(found.poses).poses[5], base(5) @ T_BASE_LIDAR, atol=1e-6)
    only = write(tmp_path / "b.bag", "ros1", repeated, camera, points, static=False)
    assert unpacked(only, tmp_path / "b")[0].metrics["poses"] == "sweeps"


def test_sqlite_bags_without_message_definitions_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "sqlite3")
    database = sqlite3.connect(next(path.glob("*.db3")))
    database.execute("update schema set schema_version = 3")
    database.execute("drop table message_definitions")
    database.commit()
    database.close()
    assert unpacked(path, tmp_path / "out")[0].metrics["photos"] == SWEEPS


def test_photo_interval_drops_photos_in_between(tmp_path: Path) -> None:
    found, _ = unpacked(write(tmp_path / "bag"), tmp_path / "out", photo_interval=0.25)
    assert found.photos is not None and len(list((found.photos / "front").iterdir())) == 3


def test_defaults_skip_non_sensor_topics_with_a_reason(tmp_path: Path) -> None:
    def others(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/cloud_map", time, "map", records(XYZ))
        bag.cloud("/points_filtered", time, "lidar", records(XYZ[:20]))
        rgb = records(XYZ, rgb=np.ones(len(XYZ), np.float32))
        bag.cloud("/depth/points", time, "camera", rgb, height=6, width=10, row_step=160)
        bag.image("/front/depth", time, "camera", np.ones((30, 40), np.uint16), "16UC1")
        content = cv2.imencode(".jpg", photo(k))[1].tobytes()
        bag.compressed("/front/image_raw/compressed", time, "camera", content)
        bag.compressed("/rear/image/compressed", time, "rear", content)
        bag.write("/chatter", "std_msgs/String", time, data="hello")

    with opened(write(tmp_path / "bag", "mcap", tf, camera, points, others)) as bag:
        uses, _, error = described(inspected(bag), BagParams())
    assert error is None
    for topic, text in {
        "/points": "sweeps; frame lidar, points with times", "/cloud_map": "in the frame map",
        "/points_filtered": "of the same lidar as /points", "/depth/points": "of a depth camera",
        "/front/image_raw": "photos; frame camera, opencv 40x30", "/front/depth": "depth images",
        "/front/image_raw/compressed": "of the same camera as /front/image_raw",
        "/rear/image/compressed": "no CameraInfo",
        "/front/camera_info": "calibration of /front/image_raw", "/tf": "poses of lidar in map", "/chatter": "not used",
    }.items():  # fmt: skip
        assert text in uses[topic], (topic, uses[topic])


def raw(topic: str, kind: str) -> Writer:
    """Writer of messages with a header and bytes, of a type that the import doesn't know."""

    def write_raw(bag: BagFile, k: int, time: float) -> None:
        if kind not in bag.store.types:
            bag.store.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\n", kind))
        bag.write(topic, kind, time, header=bag.header(time, "lidar"), data=np.zeros(9, np.uint8))

    return write_raw


@pytest.mark.parametrize("form", FORMATS)
def test_packets_and_videos_are_named_with_what_to_do(tmp_path: Path, form: str) -> None:
    packets = raw("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan")
    video = raw("/front/video", "foxglove_msgs/msg/CompressedVideo")
    packed = raw("/rear/points/draco", "point_cloud_interfaces/msg/CompressedPointCloud2")
    path = write(bag_path(tmp_path, form), form, tf, packets, packed, video)
    with opened(path) as bag:
        uses, _, error = described(inspected(bag), BagParams())
    assert "raw packets of a lidar, whose driver makes PointCloud2" in uses["/velodyne_packets"]
    assert "republish it as CompressedImage" in uses["/front/video"]
    assert "republish them as PointCloud2" in uses["/rear/points/draco"]
    assert error is not None and "/velodyne_packets has the lidar's raw packets: play the bag" in str(error)


def test_damaged_messages_are_skipped_and_counted(tmp_path: Path) -> None:
    def damaged(bag: BagFile, k: int, time: float) -> None:
        if k in (2, 5):
            bag.cloud("/points", time, "lidar", records(XYZ), data=np.zeros(7, np.uint8))
        else:
            points(bag, k, time)
        bag.compressed(
            "/front/image_raw/compressed", time, "camera", b"" if k == 3 else cv2.imencode(".png", photo(k))[1]
        )
        bag.camera_info("/front/camera_info", time, "camera", CAMERA)

    found, notes = unpacked(write(tmp_path / "bag", "mcap", tf, damaged), tmp_path / "out")
    assert found.metrics["sweeps"] == 6 and found.metrics["photos"] == 7
    assert any(
        "2 of /points's messages are left out: the first, of /points at 0.200 s, has 7 bytes" in n for n in notes
    )
    assert any("at 0.300 s, has no data" in note for note in notes)


def test_sweep_without_a_time_span_is_dropped_and_distant_point_times_reported(tmp_path: Path) -> None:
    def odd(bag: BagFile, k: int, time: float) -> None:
        offsets = OFFSETS * 0 if k == 0 else OFFSETS + np.float32(3.0 if k == 4 else 0.0)
        bag.cloud("/points", time, "lidar", records(XYZ, time=offsets))

    found, notes = unpacked(write(tmp_path / "bag", "mcap", tf, odd), tmp_path / "out")
    files = list_files(found.sweeps)
    sweep = read_sweep(files[1])
    assert len(files) == SWEEPS - 1 and sweep.time is not None and np.ptp(sweep.time) == pytest.approx(PERIOD, abs=1e-6)
    assert any("/points at 0.400 s, has points whose times are 3.1 s from that of the message" in n for n in notes)


def test_gaps_and_repeated_messages_are_reported(tmp_path: Path) -> None:
    def gaps(bag: BagFile, k: int, time: float) -> None:
        points(bag, k, time if k < 5 else time + 3)
        if k == 2:
            points(bag, k, time)

    found, notes = unpacked(write(tmp_path / "bag", "mcap", tf, gaps), tmp_path / "out")
    assert found.metrics["sweeps"] == SWEEPS
    assert "/points has 1 gaps of up to 3.1 s" in notes and any("same time as the one before" in n for n in notes)


def jump(seconds: float) -> Writer:
    return lambda bag, k, time: bag.cloud(
        "/points", time + (seconds if k > 3 else 0), "lidar", records(XYZ), log_s=time
    )


@pytest.mark.parametrize(
    ("writers", "params", "kind", "message"),
    [
        ((tf,), {}, DataError, r"no sweeps \(PointCloud2.*/tf \(tf2_msgs"),
        ((tf, jump(-3600)), {}, InputError, r"/points at 0\.400 s is 3599\.9 s before the previous.*--stamps log"),
        ((tf, jump(500)), {}, InputError, r"at 0\.400 s has a time stamp that jumped by 500\.0 s.*--stamps log"),
        ((points, camera), {"poses": "tf"}, InputError, r"no moving transform above the frame 'lidar'.*base > lidar"),
        ((points, tf), {"lidar": ("/velodyne",)}, SettingError, r"'/velodyne' is not in the bag.*one of: /points"),
        ((points, tf), {"camera": ("/points",)}, SettingError, r"is of the type sensor_msgs/msg/PointCloud2"),
        ((points, tf), {"poses": "gnss"}, InputError, "no topic of NavSatFix"),
        ((points, tf), {"gps": "/fix"}, SettingError, r"'/fix' is not in the bag.*one of: none"),
        ((points, tf), {"transform": ("a b 1",)}, SettingError, "is not a transform"),
        (
            (points, tf, lambda b, k, t: b.image("/c/image", t, "camera", photo(k), "rgb8")), {"camera": ("/c/image",)},
            InputError, r"no CameraInfo of /c/image \(it has none\).*--intrinsics",
        ),
        (
            (points, tf, lambda b, k, t: b.image("/front/image", t, "camera", photo(k)[:0], "rgb8")),
            {"camera": ("/front/image",)}, InputError, "first image of /front/image has no data",
        ),
        (
            (points, lambda b, k, t: b.odometry("/odom", t, ("odom", "rear_axle"), base(k))), {"poses": "/odom"},
            InputError, "between the frames 'rear_axle' and 'lidar'",
        ),
        ((lambda b, k, t: b.cloud("/points", t, "lidar", records(XYZ * np.nan)), tf), {}, DataError, "has points"),
    ],
)  # fmt: skip
def test_errors_name_topic_cause_and_remedy(
    tmp_path: Path, writers: tuple[Writer, ...], params: dict[str, Any], kind: type[ScanError], message: str
) -> None:
    path = write(tmp_path / "bag", "mcap", *writers)
    with pytest.raises(ScanError, match=message) as caught:
        unpacked(path, tmp_path / "out", **params)
    assert type(caught.value) is kind


def test_missing_camera_transform_is_reported_and_can_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "mcap", tf, camera, points, static=False)
    with pytest.raises(InputError, match=r"'camera' and 'lidar'; its transforms: map > base \(moving\)"):
        unpacked(path, tmp_path / "a", poses="sweeps")
    links = ("base lidar 0 0 0 0 0 0 1", "lidar camera 0 0 1 0 0 0 1")
    found, _ = unpacked(path, tmp_path / "b", transform=links)
    assert found.photos is not None and read_rig(found.photos)[0].T_camera_scanner[2, 3] == -1


def test_each_topic_gets_its_camera_of_a_chain_of_kalibr(tmp_path: Path) -> None:
    def stereo(bag: BagFile, k: int, time: float) -> None:
        for side in ("left", "right"):
            bag.image(f"/{side}/image_raw", time, "camera", photo(k), "rgb8")

    def one(side: str, focal: float) -> str:
        return (
            f"{{camera_model: pinhole, intrinsics: [{focal}, {focal}, 19, 14], distortion_model: radtan, "
            f"distortion_coeffs: [-0.1, 0.02, 0.001, 0.002], resolution: [40, 30], rostopic: /{side}/image_raw}}\n"
        )

    path, chain = write(tmp_path / "bag", "mcap", tf, points, stereo), tmp_path / "camchain.yaml"
    chain.write_text(f"cam0: {one('left', 35)}cam1: {one('right', 36)}", encoding="utf-8")
    topics = {"intrinsics": chain, "camera": ("/left/image_raw", "/right/image_raw")}
    found, notes = unpacked(path, tmp_path / "a", **topics)
    lenses = {one.id: one.camera for one in read_rig(present(found.photos))}
    assert notes == [] and (lenses["left"].fx, lenses["right"].fx) == (35, 36)
    assert lenses["left"].distortion == CAMERA.distortion
    chain.write_text(f"cam0: {one('left', 35)}", encoding="utf-8")
    _, notes = unpacked(path, tmp_path / "b", **topics)
    assert "/left/image_raw and /right/image_raw have the same camera in camchain.yaml" in notes


def truncated(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def overwritten(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3 : len(content) // 2] = bytes(len(content) // 2 - len(content) // 3)
    path.write_bytes(content)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("damage", [lambda p: truncated(p, 0.6), lambda p: truncated(p, 0.01), overwritten])
def test_damaged_bags_are_rejected_with_a_remedy(tmp_path: Path, form: str, damage: Callable[[Path], None]) -> None:
    path = write(bag_path(tmp_path, form), form)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    damage(file)
    for i, place in enumerate({path, file}):
        try:
            _, notes = unpacked(place, tmp_path / f"out{i}")
            assert any("missing" in note for note in notes)  # a chunk without a checksum lost some of its records
        except (InputError, DataError) as error:
            assert "damaged" in error.cause or "not a readable bag" in error.cause or "message" in error.cause
            assert error.remedy


def test_empty_and_invalid_files_are_rejected(tmp_path: Path) -> None:
    with bag_file(tmp_path / "empty", "mcap"):
        pass
    (tmp_path / "zero.bag").touch()
    (tmp_path / "text.mcap").write_text("hello", encoding="utf-8")
    (tmp_path / "text.db3").write_text("hello", encoding="utf-8")
    sqlite3.connect(tmp_path / "other.db3").execute("create table a (b)").connection.close()
    (tmp_path / "folder").mkdir()
    (tmp_path / "cloud.ply").touch()
    for name, kind, message in (
        ("empty", DataError, "contains no messages"), ("zero.bag", InputError, "is an empty file"),
        ("text.mcap", InputError, "is not a readable bag"), ("text.db3", InputError, "is not a readable bag"),
        ("other.db3", InputError, "is not a readable bag"), ("folder", InputError, "contains no bag"),
        ("cloud.ply", InputError, r"is not a bag \(\.ply\)"), ("none.mcap", InputError, "file not found"),
    ):  # fmt: skip
        with pytest.raises(ScanError, match=message) as caught:
            unpacked(tmp_path / name, tmp_path / "out")
        assert type(caught.value) is kind
    assert is_bag(tmp_path / "empty") and not is_bag(tmp_path / "folder") and not is_bag(tmp_path / "cloud.ply")


def test_folder_without_metadata_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    (path / "metadata.yaml").unlink()
    assert unpacked(path, tmp_path / "out")[0].metrics["sweeps"] == SWEEPS


def test_missing_package_is_reported_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "bag")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(UnavailableError, match=r"rosbags.*pip install 'scan2sim\[bag\]'"):
        unpacked(path, tmp_path / "out")
