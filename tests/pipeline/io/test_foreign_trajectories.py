"""Trajectories as TUM, evo, EuRoC, MulRan, KITTI and ROS write them: the same poses by one reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import trajectory

COUNT, START_NS = 20, 1_403_636_580_000_000_000
NS = START_NS + 50_000_000 * np.arange(COUNT)
POSITIONS = np.random.default_rng(1).normal(0, 5, (COUNT, 3)).round(6)
ROTATIONS = Rotation.random(COUNT, random_state=2)
XYZW = ROTATIONS.as_quat()
MATRICES = np.concatenate([ROTATIONS.as_matrix(), POSITIONS[:, :, None]], axis=2).reshape(COUNT, 12)


def lines(*columns: F64 | list[str], separator: str = ",") -> str:
    """Lines of columns, (T,) texts or (T, K) numbers."""
    made = []
    for row in zip(*columns, strict=True):
        cells = [cell for part in row for cell in ([part] if isinstance(part, str) else [f"{v:.9f}" for v in part])]
        made.append(separator.join(cells))
    return "\n".join(made) + "\n"


ns = [str(time) for time in NS]
seconds = [f"{time // 10**9}.{time % 10**9:09d}" for time in NS.tolist()]
halves = [f"{time // 10**9},{time % 10**9}" for time in NS.tolist()]
wxyz = np.roll(XYZW, 1, axis=1)
zeros = np.zeros((COUNT, 9))
frame = ["map"] * COUNT
both = ["odom,base_link"] * COUNT
later = [str(time + 7_000_000) for time in NS.tolist()]
numbers = [str(number) for number in range(COUNT)]

EUROC = ("#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
         "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
         "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n")  # fmt: skip
ROS1 = ("%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y,"
        "field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,"
        "field.pose.orientation.w\n")  # fmt: skip
ROS2 = ("header.stamp.sec,header.stamp.nanosec,header.frame_id,pose.pose.position.x,pose.pose.position.y,"
        "pose.pose.position.z,pose.pose.orientation.x,pose.pose.orientation.y,pose.pose.orientation.z,"
        "pose.pose.orientation.w,twist.twist.linear.x\n")  # fmt: skip

FILES: dict[str, tuple[str, str]] = {
    "TUM": ("a.tum", lines(seconds, POSITIONS, XYZW, separator=" ")),
    "TUM with comments": ("a.txt", "# truth\n# file: x\n" + lines(seconds, POSITIONS, XYZW, separator=" ")),
    "TUM with double lines": (
        "a.txt", "".join(2 * (line + "\n") for line in lines(seconds, POSITIONS, XYZW, separator=" ").splitlines())
    ),
    "TUM with names": ("a.txt", "timestamp tx ty tz qx qy qz qw\n" + lines(seconds, POSITIONS, XYZW, separator=" ")),
    "TUM, w first by its comment": (
        "a.tum", "# poses\n# timestamp tx ty tz qw qx qy qz\n" + lines(seconds, POSITIONS, wxyz, separator=" ")
    ),
    "TUM, w first, tabs": ("a.txt", "#time,x,y,z,qw,qx,qy,qz\n" + lines(seconds, POSITIONS, wxyz, separator="\t")),
    "TUM in nanoseconds (ORB-SLAM3)": ("a.txt", lines(ns, POSITIONS, XYZW, separator=" ")),
    "TUM, Windows": ("a.txt", lines(seconds, POSITIONS, XYZW, separator="\t").replace("\n", "\r\n")),
    "EuRoC": ("data.csv", EUROC + lines(ns, POSITIONS, wxyz, zeros)),
    "EuRoC without names": ("data.csv", lines(ns, POSITIONS, wxyz, zeros)),
    "MulRan": ("global_pose.csv", lines(ns, MATRICES)),
    "KITTI with times": ("a.txt", lines(seconds, MATRICES, separator=" ")),
    "evo": ("a.csv", ",x,y,z,qw,qx,qy,qz\n" + lines(seconds, POSITIONS, wxyz)),
    "own": ("a.csv", "time,x,y,z,qx,qy,qz,qw\n" + lines(seconds, POSITIONS, XYZW)),
    "other order and case": ("a.csv", "QW,QX,QY,QZ,X,Y,Z,Timestamp\n" + lines(wxyz, POSITIONS, seconds)),
    "semicolons": ("a.csv", "timestamp;tx;ty;tz;qx;qy;qz;qw\n" + lines(seconds, POSITIONS, XYZW, separator=";")),
    "microseconds": ("a.csv", "t,px,py,pz,qx,qy,qz,qw\n" + lines([one[:-3] for one in ns], POSITIONS, XYZW)),
    "no names": ("a.csv", lines(seconds, POSITIONS, XYZW)),
    "ROS 1": ("a.csv", ROS1 + lines(later, numbers, ns, frame, POSITIONS, XYZW)),
    "ROS 2": ("a.csv", ROS2 + lines(halves, frame, POSITIONS, XYZW, zeros[:, :1])),
    "ROS 2 without names": ("a.csv", lines(halves, frame, POSITIONS, XYZW)),
    "ROS 2 odometry without names": ("a.csv", lines(halves, both, POSITIONS, XYZW, np.zeros((COUNT, 36)))),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_every_file_has_the_same_poses(tmp_path: Path, name: str) -> None:
    file, text = FILES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    found = trajectory.read(tmp_path / file, timed=True)
    assert len(found) == COUNT and found.times == pytest.approx(NS / 1e9, abs=1e-6)
    assert np.allclose(found.positions, POSITIONS)
    assert found.rotations is not None and np.allclose(found.rotations, ROTATIONS.as_matrix(), atol=1e-6)


@pytest.mark.parametrize("name", FILES)
def test_inspect_recognizes_a_trajectory(tmp_path: Path, name: str) -> None:
    file, text = FILES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / file)])
    assert shown.exit_code == 0, shown.output
    for expected in ("trajectory:", "20.0 Hz", "import sweeps"):
        assert expected in " ".join(shown.output.split())


def test_inspect_reports_poses_without_times(tmp_path: Path) -> None:
    (tmp_path / "00.txt").write_text(lines(MATRICES, separator=" "), encoding="utf-8")
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / "00.txt")])
    assert shown.exit_code == 0 and "none: 10 poses per second are assumed" in shown.output


@pytest.mark.parametrize("header", ["x,y,z,r,g,b,intensity,time", "time,x,y,z,r,g,b,class", "x,y,z,nx,ny,nz,r,g", ""])
def test_a_cloud_is_no_trajectory(tmp_path: Path, header: str) -> None:
    (tmp_path / "a.csv").write_text(header + "\n" + "1,2,3,4,5,6,7,8\n" * 9, encoding="utf-8")
    assert not trajectory.is_trajectory(tmp_path / "a.csv")


def test_poses_of_a_standing_vehicle_are_kept_without_times(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(lines(np.repeat(MATRICES[:1], 5, axis=0), separator=" "), encoding="utf-8")
    assert len(trajectory.read(path)) == 5


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda text: text.replace("qw,qx,qy,qz", "qw,qx,qy,q"), "rotation needs all of"),
        (lambda text: text.replace(",x,", ",x,x,", 1).replace("\n", ",0\n").replace(",0\n", "\n", 1), "two columns"),
        (lambda text: text.replace(",x,y,z", ",a,b,c"), "columns are ,a,b,c"),
        (lambda text: "\n".join(text.splitlines()[1:]).replace(",", ",0,", 1), "9 columns|and no header line"),
    ],
)
def test_tables_that_are_not_understood_are_refused(tmp_path: Path, change: Callable[[str], str], cause: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(change(FILES["evo"][1]), encoding="utf-8")
    with pytest.raises(InputError, match=cause):
        trajectory.read(path)


def test_a_matrix_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "global_pose.csv"
    path.write_text(lines(ns, MATRICES + 1), encoding="utf-8")
    with pytest.raises(InputError, match="not a rotation matrix"):
        trajectory.read(path)


@pytest.mark.parametrize(
    "header",
    ["time;x;y;z", "Zeit;Rechtswert;Hochwert;Höhe", "GPS_Time [s];Easting [m];Northing [m];Elevation [m]"],
)
@pytest.mark.parametrize("comma", [False, True])
def test_tables_of_spreadsheets_in_other_languages(tmp_path: Path, header: str, comma: bool) -> None:
    text = lines(seconds, POSITIONS, separator=";")
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n{text.replace('.', ',') if comma else text}", encoding="cp1252")
    found = trajectory.read(path, timed=True)
    assert np.allclose(found.positions, POSITIONS) and found.times == pytest.approx(NS / 1e9, abs=1e-6)


def test_four_columns_with_other_names_are_not_taken_for_positions(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,latitude,longitude,altitude\n" + lines(seconds, POSITIONS), encoding="utf-8")
    with pytest.raises(InputError, match=r"is a GPS track.*--gps"):
        trajectory.read(path)
