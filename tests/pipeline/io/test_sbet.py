"""SBET files are read into the CRS of the clouds, with the directions of its grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io import sbet, trajectory
from tests.fakes.sbet import write
from tests.present import present

CRS = "EPSG:32632"
ORIGIN = (700_000.0, 5_400_000.0, 300.0)
"""200 km east of the central meridian: grid north is 2 degrees from true north."""


def drive(rate: float) -> tuple[F64, F64]:
    """Times (N,) and poses (N, 4, 4) of a bend on a slope, with roll."""
    times = 345_600 + np.arange(0, 4, 1 / rate)
    t = times - times[0]
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    angles = np.column_stack([0.3 + 0.4 * t, -0.05 - 0.01 * t, 0.04 * np.sin(t)])  # yaw, pitch, roll
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :3, 3] = np.array(ORIGIN) + np.column_stack([10 * t, 3 * t**2, 0.5 * t])
    return times, poses


def test_poses_are_those_of_the_grid(tmp_path: Path) -> None:
    times, poses = drive(20.0)
    write(tmp_path / "sbet_mission1.out", CRS, times, poses)
    path = trajectory.read(tmp_path / "sbet_mission1.out", Frame(CRS, ORIGIN))
    assert np.allclose(path.times, times)
    assert np.abs(path.positions + ORIGIN - poses[:, :3, 3]).max() < 1e-4
    turned = Rotation.from_matrix(present(path.rotations)) * Rotation.from_matrix(poses[:, :3, :3]).inv()
    assert np.degrees(turned.magnitude()).max() < 0.002
    local, frame = trajectory.read_local(tmp_path / "sbet_mission1.out", CRS)
    assert np.abs(local.positions + np.asarray(frame.origin) - poses[:, :3, 3]).max() < 1e-4


def test_clouds_may_be_in_feet(tmp_path: Path) -> None:
    times, poses = drive(10.0)
    write(tmp_path / "a.sbet", CRS, times, poses)
    path = trajectory.read(tmp_path / "a.sbet", Frame(CRS, ORIGIN, unit=0.3048))
    assert np.abs(path.positions + ORIGIN - poses[:, :3, 3]).max() < 1e-3


def test_high_rates_are_thinned(tmp_path: Path) -> None:
    times, poses = drive(200.0)
    write(tmp_path / "a.out", CRS, times, poses)
    path = trajectory.read(tmp_path / "a.out", Frame(CRS))
    assert np.allclose(np.diff(path.times), 1 / sbet.RATE_HZ)


def test_inspect_says_what_the_file_is_and_where(tmp_path: Path) -> None:
    times, poses = drive(200.0)
    write(tmp_path / "a.out", CRS, times, poses)
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / "a.out")])
    assert shown.exit_code == 0, shown.output
    for text in ("SBET trajectory", "800 at 200 Hz", "48.7", "11.7", "300.0 to 302.0", "--trajectory"):
        assert text in shown.output


def test_what_is_no_sbet_file_or_damaged_is_refused(tmp_path: Path) -> None:
    times, poses = drive(20.0)
    file = tmp_path / "a.out"
    write(file, CRS, times, poses)
    with pytest.raises(InputError, match=r"positions in degrees.*--crs"):
        trajectory.read(file, Frame())
    rows = np.fromfile(file, "<f8").reshape(-1, sbet.FIELDS)
    rows[7, 1] = np.nan
    rows.tofile(file)
    with pytest.raises(InputError, match="is damaged at record 8 of 80"):
        trajectory.read(file, Frame(CRS))
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(InputError, match="not a text file"):
        trajectory.read(file, Frame(CRS))
    table = tmp_path / "text.out"
    table.write_text("time,x,y,z\n0,1,2,3\n1,2,3,4\n", encoding="utf-8")
    assert len(trajectory.read(table)) == 2
