"""Trajectory files: round trips, and errors of invalid files with file and line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError, SpaceError
from scan2sim.pipeline.core.types import Frame, Trajectory
from scan2sim.pipeline.io import trajectory
from scan2sim.pipeline.io.geodata import crs
from tests.present import present

UTM = Frame("EPSG:32633", (500_000.0, 5_400_000.0, 200.0))
FEET = Frame("EPSG:2994", (200_000.0, 250_000.0, 100.0), 0.3048)


def sample_trajectory(n: int = 12) -> Trajectory:
    """A random path; poses 3 to 5 and 9 are unsure."""
    random = np.random.default_rng(1)
    unsure = np.isin(np.arange(n), (3, 4, 5, 9))
    covariance = np.zeros((n, 6, 6))
    covariance[:, np.arange(6), np.arange(6)] = random.uniform(0.1, 2, (n, 6)) ** 2
    return Trajectory(
        1.7e9 + np.arange(n) / 10,
        random.uniform(-50, 50, (n, 3)),
        Rotation.random(n, random).as_matrix(),
        unsure,
        covariance,
    )


@pytest.mark.parametrize("frame", [Frame(), UTM, FEET])
@pytest.mark.parametrize("suffix", [".csv", ".tum", ".kitti"])
def test_trajectory_round_trip(tmp_path: Path, suffix: str, frame: Frame) -> None:
    path = sample_trajectory()
    file = tmp_path / f"a{suffix}"
    trajectory.write(file, path, frame)
    back = trajectory.read(file, frame, times=path.times if suffix == ".kitti" else None)
    assert back.rotations is not None and path.rotations is not None
    assert np.abs(back.times - path.times).max() < 1e-6
    assert np.abs(back.positions - path.positions).max() < 2e-6
    assert np.abs(back.rotations - path.rotations).max() < 1e-8
    if suffix == ".csv":
        assert back.unsure is not None and back.unsure.tolist() == present(path.unsure).tolist()
        assert back.covariance is not None and np.allclose(back.covariance, present(path.covariance), rtol=1e-5)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


def test_files_contain_coordinates_of_the_crs(tmp_path: Path) -> None:
    path = Trajectory(np.array([0.0, 1.0]), np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0]]))
    trajectory.write(tmp_path / "a.csv", path, UTM)
    assert (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()[:2] == [
        "time,x,y,z",
        "0.000000,500001.000000,5400002.000000,203.000000",
    ]


def test_kitti_has_ten_poses_per_second(tmp_path: Path) -> None:
    trajectory.write(tmp_path / "a.kitti", sample_trajectory())
    assert np.allclose(trajectory.read(tmp_path / "a.kitti").times, np.arange(12) / 10)
    with pytest.raises(InputError, match=r"has 12 poses for 3 times"):
        trajectory.read(tmp_path / "a.kitti", times=np.arange(3.0))
    with pytest.raises(InputError, match=r"has no times"):
        trajectory.read(tmp_path / "a.kitti", timed=True)


def test_format_of_other_suffixes_is_detected_by_the_first_line(tmp_path: Path) -> None:
    for suffix in (".csv", ".tum", ".kitti"):
        trajectory.write(tmp_path / f"a{suffix}", sample_trajectory())
        text = tmp_path / f"{suffix[1:]}.txt"
        text.write_text((tmp_path / f"a{suffix}").read_text(encoding="utf-8"), encoding="utf-8")
        assert np.allclose(trajectory.read(text).positions, sample_trajectory().positions)


def test_partial_columns_are_read_in_any_order(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("# Z, Y ,X,TIME,sx,sy,sz\n\n3,2,1,10,1,1,2\n6,5,4,11,1,1,2\n", encoding="utf-8")
    path = trajectory.read(tmp_path / "a.csv")
    assert path.positions.tolist() == [[1, 2, 3], [4, 5, 6]] and path.rotations is None
    assert path.covariance is not None
    assert np.diag(path.covariance[0]).tolist() == [1, 1, 4, np.inf, np.inf, np.inf]
    trajectory.write(tmp_path / "b.csv", path)
    assert (tmp_path / "b.csv").read_text(encoding="utf-8").startswith("time,x,y,z,sx,sy,sz\n")


def test_times_out_of_order_are_rejected_or_sorted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,e,n,h\n2,5,0,0\n1,4,0,0\n", encoding="utf-8")
    with pytest.raises(
        InputError, match=r"a\.csv: is not a valid trajectory \(line 3: its time is not after.*Sort by time"
    ):
        trajectory.read(tmp_path / "a.csv")
    assert trajectory.read(tmp_path / "a.csv", ordered=False).positions[:, 0].tolist() == [4, 5]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", r"a\.csv: is not a trajectory \(it contains no poses\).*time,x,y,z"),
        ("a.csv", "time,x,y,z\n", r"contains no poses"),
        ("a.csv", "1,2,3,4,5\n2,2,3,4,5\n", r"line 1: it has 5 columns and no header line.*a header line, then"),
        ("a.csv", "time,x,y\n1,2,3\n", r"line 1: columns are time,x,y"),
        ("a.csv", "time,x,y,z\n1,2,3,4\n\n2,2,3\n", r"line 4: 3 columns, expected 4"),
        ("a.csv", "time,x,y,z\n1,2,3,nan\n", r"line 2: contains NaN.*Remove"),
        ("a.csv", "time,x,y,z\n1,2,3,four\n", r"line 2: could not convert.*four"),
        ("a.csv", "time,x,y,z,qx,qy\n1,2,3,4,0,0\n", r"rotation needs all of qx,qy,qz,qw"),
        ("a.tum", "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0.5\n", r"a\.tum.*line 2: its quaternion is not normalized"),
        ("a.tum", "0 1 2 3 0 0 0 1\n0 1 2 4 0 0 0 1\n", r"line 2: its time is not after"),
        ("a.kitti", "# c\n1 0 0 5 0 1 0 5 0 0 -1 5\n", r"a\.kitti.*line 2: its left 3x3 is not a rotation matrix"),
        ("a.kitti", "1 0 0 5 0 1 0 5\n", r"line 1: 8 columns, expected 12.*row-major"),
        ("a.geojson", "{}", r"can only be written"),
    ],
)
def test_invalid_files_are_rejected_with_line_and_remedy(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        trajectory.read(tmp_path / name)


def test_unreadable_files_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\x00\x01\x02\x81")
    with pytest.raises(InputError, match=r"a\.csv: is not a text file"):
        trajectory.read(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"none\.csv"):
        trajectory.read(tmp_path / "none.csv")


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    only_positions = Trajectory(np.arange(2.0), np.zeros((2, 3)))
    trajectory.write(tmp_path / "a.csv", only_positions)
    before = (tmp_path / "a.csv").read_text(encoding="utf-8")
    with pytest.raises(DataError, match=r"contains NaN"):
        trajectory.write(tmp_path / "a.csv", Trajectory(np.arange(2.0), np.full((2, 3), np.nan)))
    with pytest.raises(SettingError, match=r"needs rotations"):
        trajectory.write(tmp_path / "a.tum", only_positions)
    with pytest.raises(SettingError, match=r"unknown trajectory format.*\.csv, \.tum"):
        trajectory.write(tmp_path / "a.xyz", only_positions)
    with pytest.raises(SettingError, match=r"GeoJSON needs a CRS"):
        trajectory.write(tmp_path / "a.geojson", only_positions)
    with pytest.raises((InputError, SpaceError)):
        trajectory.write(tmp_path / "none" / "a.csv", only_positions)
    assert (tmp_path / "a.csv").read_text(encoding="utf-8") == before and len(list(tmp_path.iterdir())) == 1


def test_geojson_contains_the_path_with_unsure_sections(tmp_path: Path) -> None:
    path = sample_trajectory()
    trajectory.write(tmp_path / "a.geojson", path, UTM)
    whole, *stretches = json.loads((tmp_path / "a.geojson").read_text(encoding="utf-8"))["features"]
    lat, lon, height = present(crs.to_wgs84(UTM, path.positions[7]))
    assert whole["geometry"]["type"] == "LineString"
    assert whole["geometry"]["coordinates"][7] == pytest.approx([lon, lat, height], abs=1e-3)
    assert whole["geometry"]["coordinates"][7][:2] == pytest.approx([lon, lat], abs=1e-7)
    assert [s["geometry"]["coordinates"] for s in stretches] == [whole["geometry"]["coordinates"][k] for k in (4, 9)]
    assert path.covariance is not None
    worst = np.sqrt(np.einsum("tkk->tk", path.covariance)[3:6, :2].max())
    assert stretches[0]["properties"]["sigma_m"] == pytest.approx(worst, abs=1e-3)
    assert stretches[0]["properties"]["end_s"] - stretches[0]["properties"]["start_s"] == pytest.approx(0.2, abs=1e-6)


def test_pose_at_interpolates_and_clamps_at_the_ends() -> None:
    path = sample_trajectory()
    assert path.rotations is not None
    times = np.linspace(path.times[0], path.times[-1], 40)
    poses = path.pose_at(times)
    assert np.allclose(poses[:, :3, 3], path.at(times))
    slerp = Slerp(path.times, Rotation.from_matrix(path.rotations))
    assert np.allclose(poses[:, :3, :3], slerp(times).as_matrix(), atol=1e-6)
    assert np.allclose(path.pose_at(path.times), path.poses)
    assert np.allclose(path.pose_at(path.times[[0, -1]] + [-5, 5]), path.poses[[0, -1]])
    one = Trajectory(path.times[:1], path.positions[:1], path.rotations[:1])
    assert np.allclose(one.pose_at([0.0, 2e9]), one.poses)
