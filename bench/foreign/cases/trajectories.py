"""Trajectories as TUM, evo, EuRoC, MulRan, KITTI and ROS write them; a hand-held path of a few metres."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, scan

Make = Callable[[Path], Sequence[object]]
COUNT, START_NS, STEP_NS = 40, 1_403_636_580_000_000_000, 50_000_000
HAND_HELD_M = 8.65
ROS1 = ("%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y,"
        "field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,"
        "field.pose.orientation.w")  # fmt: skip
ROS2 = ("header.stamp.sec,header.stamp.nanosec,header.frame_id,pose.pose.position.x,pose.pose.position.y,"
        "pose.pose.position.z,pose.pose.orientation.x,pose.pose.orientation.y,pose.pose.orientation.z,"
        "pose.pose.orientation.w,twist.twist.linear.x")  # fmt: skip


def cases() -> Iterator[Case]:
    """Cases of kinds 11 and 13."""
    for name, (suffix, text) in _files().items():
        yield Case(f"trajectory-{name}", 11, _imported(f"path{suffix}", text), check=_path_is)
    for name, text in _damaged().items():
        yield Case(f"trajectory-{name}", 11, _imported("path.csv", text), "rejected", "path.csv.*(column|line|time)")
    yield Case("hand-held", 13, _evaluated, "named", rf"length_m +{HAND_HELD_M - 0.05:.1f}")


def _positions() -> np.ndarray:
    along = np.linspace(-8, 8, COUNT)
    return PLACE + np.column_stack([along, np.sin(along / 3), np.full(COUNT, 1.75)])


def _nanoseconds() -> list[int]:
    return [START_NS + STEP_NS * i for i in range(COUNT)]


def _files() -> dict[str, tuple[str, str]]:
    """Texts by habit, with the suffix of the file."""
    rotations = Rotation.from_rotvec(np.linspace(0, 0.5, COUNT)[:, None] * (0, 0, 1))
    at, xyzw = _positions(), rotations.as_quat()
    wxyz = np.roll(xyzw, 1, axis=1)
    matrices = np.concatenate([rotations.as_matrix(), at[:, :, None]], axis=2).reshape(COUNT, 12)
    ns = [str(time) for time in _nanoseconds()]
    seconds = [f"{time // 10**9}.{time % 10**9:09d}" for time in _nanoseconds()]
    halves = [f"{time // 10**9},{time % 10**9}" for time in _nanoseconds()]
    later, frame = [str(time + 7_000_000) for time in _nanoseconds()], ["map"] * COUNT
    numbers = [str(number) for number in range(COUNT)]
    tum = _lines(" ", seconds, at, xyzw)
    return {
        "tum": (".tum", tum),
        "tum-comments": (".txt", "# truth\n# file: x\n" + tum),
        "tum-double-lines": (".txt", "".join(2 * f"{line}\n" for line in tum.splitlines())),
        "tum-header": (".txt", "timestamp tx ty tz qx qy qz qw\n" + tum),
        "tum-nanoseconds": (".txt", _lines(" ", ns, at, xyzw)),
        "tum-windows": (".txt", _lines("\t", seconds, at, xyzw).replace("\n", "\r\n")),
        "euroc": (".csv", "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
                  "q_RS_z []\n" + _lines(",", ns, at, wxyz)),
        "euroc-no-header": (".csv", _lines(",", ns, at, wxyz, np.zeros((COUNT, 9)))),
        "mulran": (".csv", _lines(",", ns, matrices)),
        "kitti-times": (".txt", _lines(" ", seconds, matrices)),
        "evo": (".csv", ",x,y,z,qw,qx,qy,qz\n" + _lines(",", seconds, at, wxyz)),
        "other-order": (".csv", "QW,QX,QY,QZ,X,Y,Z,Timestamp\n" + _lines(",", wxyz, at, seconds)),
        "semicolons": (".csv", "timestamp;tx;ty;tz;qx;qy;qz;qw\n" + _lines(";", seconds, at, xyzw)),
        "excel": (".csv", "time;x;y;z\n" + _lines(";", seconds, at).replace(".", ",")),
        "microseconds": (".csv", "t,px,py,pz,qx,qy,qz,qw\n" + _lines(",", [one[:-3] for one in ns], at, xyzw)),
        "no-header": (".csv", _lines(",", seconds, at, xyzw)),
        "positions": (".csv", "time,x,y,z\n" + _lines(",", seconds, at)),
        "unsorted": (".csv", "time,x,y,z\n" + _lines(",", seconds[20:] + seconds[:20], np.roll(at, 20, axis=0))),
        "ros1": (".csv", ROS1 + "\n" + _lines(",", later, numbers, ns, frame, at, xyzw)),
        "ros2": (".csv", ROS2 + "\n" + _lines(",", halves, frame, at, xyzw, np.zeros((COUNT, 1)))),
    }  # fmt: skip


def _damaged() -> dict[str, str]:
    seconds = [f"{time // 10**9}.{time % 10**9:09d}" for time in _nanoseconds()]
    good = "time,x,y,z\n" + _lines(",", seconds, _positions())
    lines = good.splitlines()
    return {
        "short-line": "\n".join([*lines[:9], "1403636580.4,3", *lines[10:]]),
        "latitude": good.replace("time,x,y,z", "time,latitude,longitude,altitude"),
        "other-columns": good.replace("time,x,y,z", "time,a,b,c"),
    }


def _lines(separator: str, *columns: Any) -> str:
    """Lines of columns, (T,) texts or (T, K) numbers."""
    rows = []
    for row in zip(*columns, strict=True):
        rows.append(
            [cell for part in row for cell in ([part] if isinstance(part, str) else [f"{v:.9f}" for v in part])]
        )
    return "".join(separator.join(row) + "\n" for row in rows)


def _imported(name: str, text: str) -> Make:
    def make(folder: Path) -> Sequence[object]:
        np.savetxt(folder / "cloud.xyz", scan().xyz, "%.3f")
        (folder / name).write_text(text, encoding="utf-8", newline="")
        where = ("--crs", "EPSG:32633", "--out", folder / "tile")
        return ("import", "clouds", folder / "cloud.xyz", "--trajectory", folder / name, *where)

    return make


def _path_is(folder: Path) -> str:
    """A check: the tile has the poses."""
    from scan2sim.pipeline.io.tile import read_tile

    tile = read_tile(folder / "tile")
    if tile.trajectory is None or len(tile.trajectory) != COUNT:
        return f"{0 if tile.trajectory is None else len(tile.trajectory)} poses instead of {COUNT}"
    if np.abs(tile.frame.to_crs(tile.trajectory.positions) - _positions()).max() > 1e-3:
        return "other positions"
    return "" if np.abs(tile.trajectory.times - np.array(_nanoseconds()) / 1e9).max() < 1e-5 else "other times"


def _evaluated(folder: Path) -> Sequence[object]:
    """A path of `HAND_HELD_M` in small circles, and the same 2 cm beside it."""
    angle = np.linspace(0, 40, 800)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(800)])
    path = circle * HAND_HELD_M / np.linalg.norm(np.diff(circle, axis=0), axis=1).sum()
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (800, 1))
    times = [f"{0.05 * i:.2f}" for i in range(800)]
    (folder / "truth.tum").write_text(_lines(" ", times, path, quaternions), encoding="utf-8")
    (folder / "estimate.tum").write_text(_lines(" ", times, path + [0.02, 0, 0], quaternions), encoding="utf-8")
    return ("slam", "evaluate", folder / "estimate.tum", folder / "truth.tum")
