"""Lidar odometry: sweeps without a trajectory are matched to each other, with covariances of their poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import DataError, InputError, ScanError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.slam.geometry import inverse
from scan2sim.slam.lidar_odometry import LidarOdometry, MatchedSweeps, worst_sigma
from scan2sim.slam.steps import lidar as step
from scan2sim.slam.steps.lidar import LidarParams, lidar
from scan2sim.slam.trajectory.fusion import lidar_motions

pytestmark = pytest.mark.usefixtures("steps_in_process")

pytest.importorskip("kiss_icp")
SPEED, TURN, PERIOD = 8.0, 0.15, 0.1
AHEAD = np.radians(np.linspace(-24, 12, 32))


def pose(time: float) -> F64:
    """Pose (4, 4) of the scanner on a bend to the left."""
    heading = TURN * time
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
    T[:3, 3] = [SPEED / TURN * np.sin(heading), SPEED / TURN * (1 - np.cos(heading)), 1.8]
    return T


def street(origin: F64, ray: F64, *, tunnel: bool) -> F64:
    """Ranges (N,) in metres along rays (N, 3) to ground and walls; the walls of a street have piers."""
    with np.errstate(divide="ignore", invalid="ignore"):
        far = [-origin[:, 2] / ray[:, 2]]
        for side in (-7.0, 9.0):
            far.append((side - origin[:, 1]) / ray[:, 1])
        if tunnel:
            far.append((5.0 - origin[:, 2]) / ray[:, 2])
        else:  # piers stand out from the walls, every 11 m
            for x in np.arange(-55.0, 90.0, 11.0):
                for face in (x, x + 2.5):
                    t = (face - origin[:, 0]) / ray[:, 0]
                    at = origin[:, 1] + t * ray[:, 1]
                    far.append(np.where((np.abs(at - 1.0) > 6.0) & (t > 0), t, np.inf))
    hits = np.stack(far)
    hits[~(hits > 1e-6)] = np.inf
    return np.asarray(hits.min(axis=0))


def sweep(time: float, rng: np.random.Generator, *, tunnel: bool = False, straight: bool = False) -> tuple[F64, F64]:
    """(N, 3) points in the axes of the moment when each was measured, and (N,) seconds since the sweep's time."""
    columns = np.pi - (np.arange(450) + 0.5) / 450 * 2 * np.pi
    azimuth, elevation = (a.ravel() for a in np.meshgrid(columns, AHEAD))
    flat = np.cos(elevation)
    ray = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    since = -azimuth / (2 * np.pi) * PERIOD
    if straight:
        poses = np.tile(np.eye(4), (len(ray), 1, 1))
        poses[:, 0, 3], poses[:, 2, 3] = SPEED * (time + since), 1.8
    else:
        poses = np.stack([pose(t) for t in np.linspace(time - PERIOD / 2, time + PERIOD / 2, 451)])
        poses = poses[np.rint((since / PERIOD + 0.5) * 450).astype(int)]
    far = street(poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], ray), tunnel=tunnel)
    far += rng.normal(0, 0.01, len(far))
    keep = far < 60
    return (ray * far[:, None])[keep], since[keep]


def write(folder: Path, count: int, **how: Any) -> Path:
    """Sweeps as LAZ, with the points' own times."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(3)
    for i in range(count):
        xyz, since = sweep(i * PERIOD, rng, **how)
        las.write(
            folder / f"{i * PERIOD:.3f}.laz", PointCloud(Frame(), xyz.astype(np.float32), time=since + i * PERIOD)
        )
    return folder


def position_errors(poses: F64, times: F64) -> F64:
    """Position errors (N,) in metres, in the axes of the first pose."""
    truth = np.stack([pose(t) for t in times])
    return np.linalg.norm(poses[:, :3, 3] - (inverse(truth[0]) @ truth)[:, :3, 3], axis=1)


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("street") / "sweeps", 25)


def matched(sweeps: Path, out: Path, **how: Any) -> MatchedSweeps:
    out.mkdir(parents=True, exist_ok=True)
    done = lidar({"sweeps": sweeps}, LidarParams(**how), out, silent, out / "checkpoint")
    return MatchedSweeps.load(done.files["matched"])


def test_registration_estimates_sweep_poses_and_covariances(sweeps: Path, tmp_path: Path) -> None:
    found = matched(sweeps, tmp_path, deskew="times")
    assert position_errors(found.poses, found.times).max() < 0.25 and found.sure.all() and found.overlap.min() > 0.6
    kitti = matched(sweeps, tmp_path / "kitti", deskew="kitti")
    np.testing.assert_allclose(kitti.poses, found.poses, atol=0.03)
    rigid = matched(sweeps, tmp_path / "none")
    assert position_errors(rigid.poses, rigid.times).max() > position_errors(found.poses, found.times).max()


def test_interrupted_run_resumes(sweeps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = matched(sweeps, tmp_path / "whole", deskew="times")
    monkeypatch.setattr(step, "CHECKPOINT_INTERVAL_S", 0.0)
    seen: list[float] = []

    def stop(fraction: float, message: str = "") -> None:
        seen.append(fraction)
        if len(seen) == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lidar({"sweeps": sweeps}, LidarParams(deskew="times"), tmp_path, stop, tmp_path / "checkpoint")
    again: list[float] = []
    done = lidar(
        {"sweeps": sweeps}, LidarParams(deskew="times"), tmp_path, lambda f, _="": again.append(f),
        tmp_path / "checkpoint",
    )  # fmt: skip
    assert len(again) == 25 - 11
    np.testing.assert_allclose(MatchedSweeps.load(done.files["matched"]).poses, whole.poses, atol=1e-6)


def test_poses_along_a_tunnel_are_unsure(tmp_path: Path) -> None:
    found = matched(write(tmp_path / "tunnel", 8, tunnel=True, straight=True), tmp_path, deskew="times")
    assert not found.sure.any() and (worst_sigma(found.covariance) > 0.5).all()
    steps = lidar_motions(found)
    along = np.sqrt(steps.covariance[:, 0, 0].sum())  # of the whole path
    assert along > 0.5 * SPEED * found.times[-1]
    across = np.sqrt(found.covariance[:, [1, 2], [1, 2]].max())
    assert across < 0.1


def test_sweeps_without_a_trajectory_become_a_tile(sweeps: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, f"import sweeps {sweeps} --deskew times --out {tmp_path}/tile --voxel 0.2")
    assert result.exit_code == 0, result.output
    assert "placed by sweeps (100 % of the motions)" in result.output
    tile = read_tile(tmp_path / "tile")
    assert tile.trajectory is not None
    found = trajectory_io.read(tmp_path / "tile-path" / "trajectory.csv")
    assert position_errors(found.poses, found.times).max() < 0.25 and len(tile.trajectory) == 25
    again = CliRunner().invoke(app, f"import sweeps {sweeps} --deskew times --out {tmp_path}/b --voxel 0.2")
    assert again.exit_code == 0 and (tmp_path / "b-path").is_dir()


def test_unmatched_sweeps_are_reported(sweeps: Path, tmp_path: Path) -> None:
    def run(folder: Path, *options: str) -> str:
        result = CliRunner().invoke(app, ["import", "sweeps", str(folder), "--out", str(tmp_path / "tile"), *options])
        assert isinstance(result.exception, ScanError) and not (tmp_path / "tile").exists(), result.output
        return str(result.exception)

    files = sorted(sweeps.iterdir())
    assert "holds only one sweep" in run(files[0])
    apart = tmp_path / "apart"
    apart.mkdir()
    rng = np.random.default_rng(0)
    for i in range(4):  # each sweep from a different place
        xyz = rng.normal(0, 1.0, (2000, 3)) + 30 * np.array([np.cos(2 * i), np.sin(2 * i), 0])
        las.write(apart / f"{i}.laz", PointCloud(Frame(), xyz.astype(np.float32)))
    assert "overlap too little with each other" in run(apart)
    far = tmp_path / "far"
    far.mkdir()
    for i in range(3):
        las.write(far / f"{i}.laz", PointCloud(Frame(), np.full((5, 3), 500 + i, np.float32)))
    assert "has no points within range" in run(far)
    (tmp_path / "gps.csv").write_text("time,x,y,z\n0,0,0,0\n1,8,0,0\n", encoding="utf-8")
    assert "its sweeps have no times" in run(apart, "--gps", str(tmp_path / "gps.csv"))
    (tmp_path / "late.csv").write_text("time,x,y,z\n900,0,0,0\n901,8,0,0\n", encoding="utf-8")
    assert "spans 900.00 to 901.00 s" in run(sweeps, "--gps", str(tmp_path / "late.csv"))
    assert "has no times for its points" in run(apart, "--deskew", "times")
    names = tmp_path / "times.txt"
    names.write_text("0\n2\n1\n", encoding="utf-8")
    assert "time isn't later" in run(far, "--times", str(names))


def test_empty_sweep_is_skipped(sweeps: Path, tmp_path: Path) -> None:
    folder = tmp_path / "some"
    folder.mkdir()
    for i, file in enumerate(sorted(sweeps.iterdir())[:8]):
        if i == 4:
            las.write(folder / file.name, PointCloud(Frame(), np.full((3, 3), 900, np.float32)))
        else:
            (folder / file.name).symlink_to(file)
    found = matched(folder, tmp_path, deskew="none")
    assert list(found.sure) == [True] * 3 + [False] * 2 + [True] * 2
    assert position_errors(found.poses, found.times).max() < 0.3


def test_invalid_result_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "matched.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="is no file of matched sweeps"):
        MatchedSweeps.load(tmp_path / "matched.npz")


def test_single_sweep_has_the_identity_pose() -> None:
    odometry = LidarOdometry()
    xyz, since = sweep(0.0, np.random.default_rng(0))
    odometry.add(0.0, xyz.astype(np.float32), since)
    assert np.array_equal(odometry.matched().poses, [np.eye(4)]) and len(odometry.matched().covariance) == 0


def test_single_sweep_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds only one sweep"):
        matched(write(tmp_path / "one", 1), tmp_path)
