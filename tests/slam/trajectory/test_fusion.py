"""Lidar, camera and GPS in one graph: as accurate as the best source, robust to errors of each."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.slam.geometry import inverse
from scan2sim.slam.lidar_odometry import MatchedSweeps
from scan2sim.slam.steps.fuse import FuseParams, fuse_path
from scan2sim.slam.trajectory.fusion import (
    Fused,
    RelativeMotions,
    camera_motions,
    fuse,
    lidar_motions,
)
from tests.fakes.lidar_drive import Simulated, simulated
from tests.fakes.slam_drive import ate
from tests.present import present

ALL = ("lidar", "camera", "gps")


def fused_error(fused: Fused, drive: Simulated) -> float:
    return ate(fused.trajectory.positions, drive.truth[:, :3, 3], scaled=False)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_fusion_of_all_sources_is_as_good_as_the_best_one(seed: int) -> None:
    whole = simulated(seed, tunnel=(0, 0), dark=(0, 0), outliers=0)
    alone = whole.measure()
    assert alone["fused"] < 1.1 * min(alone["lidar"], alone["visual"], alone["gps"])
    failing = simulated(seed)
    broken = failing.measure()
    assert broken["lidar"] > 5 and broken["visual"] > 1 and broken["gps"] > 5
    assert broken["fused"] < 0.8
    path = failing.fused(*ALL).trajectory
    assert not present(path.unsure).any()
    error = path.positions - failing.truth[:, :3, 3]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(present(path.covariance)[:, :3, :3]), error)
    assert (squared < 7.81).mean() > 0.9  # of 95 % ellipsoids


def test_other_sources_cover_gps_gaps_and_dark_video() -> None:
    drive = simulated(1)
    assert fused_error(drive.fused("lidar"), drive) > 5
    both = drive.fused("lidar", "camera")
    assert fused_error(both, drive) < 1.0 and not present(both.trajectory.unsure).any()
    scale = 1 / np.median(both.scale)
    assert scale == pytest.approx(np.median(np.linalg.norm(np.diff(drive.camera.positions, axis=0), axis=1)), rel=0.1)


def test_failure_of_all_sources_is_reported() -> None:
    drive = simulated(2, tunnel=(150, 190), dark=(140, 200))
    blind = drive.fused("lidar", "camera")
    unsure = present(blind.trajectory.unsure)
    assert unsure[151:191].all() and not unsure[:150].any() and unsure[191:].all()
    seen = drive.fused(*ALL)
    unsure = present(seen.trajectory.unsure)
    assert unsure[151:191].all() and not unsure[:150].any() and not unsure[195:].any()  # GPS gives the distance


def test_path_is_robust_to_gps_outliers() -> None:
    clean, jumping = simulated(3, outliers=0), simulated(3)
    assert np.array_equal(clean.lidar.T, jumping.lidar.T)
    a, b = (drive.fused(*ALL).trajectory.positions for drive in (clean, replace(clean, gps=jumping.gps)))
    assert np.abs(a - b).max() < 1.5
    assert np.abs(jumping.gps - clean.gps).max() > 30


def test_overconfident_wrong_source_is_down_weighted() -> None:
    drive = simulated(4, tunnel=(0, 0), dark=(0, 0), outliers=0)
    lidar = drive.lidar.T.copy()
    lidar[200:210, 0, 3] = 0.0  # slipped, with an overconfident covariance
    wrong = replace(drive, lidar=drive.lidar._replace(T=lidar))
    found = wrong.fused(*ALL)
    assert found.trust["lidar"][200:210].max() < 0.2 < found.trust["camera"][200:210].min()
    assert fused_error(found, wrong) < 1.0 < fused_error(wrong.fused("lidar"), wrong)


def test_dead_reckoned_camera_poses_are_weighted_by_covariance() -> None:
    drive = simulated(5)
    n = len(drive.times)
    known = np.tile(np.diag([1e-4] * 3 + [1e-8] * 3), (n, 1, 1))
    known[200:] += np.diag([9.0] * 3 + [0.04] * 3)
    steps = camera_motions(replace(drive.camera, covariance=known), drive.times)
    spread = np.sqrt(steps.covariance[:, 0, 0])
    assert spread[199] > 2.5 and spread[:199].max() < 0.1 and spread[200:].max() < 0.1
    assert not steps.sure[250:300].any() and steps.sure[:249].all()
    late = camera_motions(replace(drive.camera, times=drive.times + 5.0), drive.times)
    assert not late.sure[:50].any() and late.sure[60:200].all()


def test_errors_within_a_tunnel_are_fully_correlated() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    covariance = np.tile(np.diag([1e-4] * 6), (5, 1, 1))
    covariance[1:4, 0, 0] = 1.0
    steps = lidar_motions(MatchedSweeps(np.arange(6.0), poses, covariance, np.ones(5)))
    assert list(steps.sure) == [True, False, False, False, True]
    assert steps.covariance[:, 0, 0] == pytest.approx([1e-4, 3, 3, 3, 1e-4])


# --- as files


def recorded(folder: Path, drive: Simulated) -> dict[str, Path]:
    """Write the sensor data of a drive as inputs of the step."""
    (folder / "sweeps").mkdir(parents=True)
    for time in drive.times:
        las.write(folder / "sweeps" / f"{time:.3f}.laz", PointCloud(Frame(), np.ones((1, 3), np.float32)))
    poses = [np.eye(4)]
    for step in drive.lidar.T:
        poses.append(poses[-1] @ step)
    overlap = np.ones(len(drive.lidar.T))
    MatchedSweeps(drive.times, np.array(poses), drive.lidar.covariance, overlap).save(folder / "matched.npz")
    trajectory_io.write(folder / "camera.csv", drive.camera)
    np.savetxt(folder / "T.txt", drive.T_camera_scanner[:3], "%.9f")
    table = np.column_stack([drive.times + 100, drive.gps])
    np.savetxt(folder / "gps.csv", table, "%.4f", delimiter=",", header="time,x,y,z", comments="")
    beside = {"matched": "matched.npz", "poses": "camera.csv", "extrinsics": "T.txt", "gps": "gps.csv"}
    return {name: folder / file for name, file in {"sweeps": "sweeps", **beside}.items()}


def placed(files: dict[str, Path], out: Path, *names: str, **how: float | str) -> tuple[Trajectory, str]:
    (out / "-".join(names)).mkdir(parents=True)
    given = {name: files[name] for name in ("sweeps", *names)}
    done = fuse_path(given, FuseParams.model_validate(how), out / "-".join(names), silent)
    return trajectory_io.read(done.files["trajectory"]), done.metrics["summary"]


def test_given_sources_are_fused_and_reported(tmp_path: Path) -> None:
    drive = simulated(6, outliers=0)
    files, truth = recorded(tmp_path, drive), drive.truth[:, :3, 3]

    def error(path: Trajectory) -> F64:
        return np.linalg.norm(path.positions - truth, axis=1)

    alone, summary = placed(files, tmp_path / "out", "matched")
    assert summary == "placed by sweeps (85 % of the motions)" and present(alone.unsure).mean() > 0.5
    path, summary = placed(files, tmp_path / "out", "matched", "poses", "extrinsics")
    assert summary == "placed by sweeps (85 % of the motions), trajectory (87 % of the motions)"
    assert error(path).max() < 5 and ate(path.positions, truth, scaled=False) < 1
    np.savetxt(tmp_path / "inverse.txt", inverse(drive.T_camera_scanner)[:3], "%.9f")
    inverted = files | {"extrinsics": tmp_path / "inverse.txt"}
    same, _ = placed(inverted, tmp_path / "inverted", "matched", "poses", "extrinsics", invert_extrinsics=True)
    assert np.allclose(same.positions, path.positions, atol=1e-4)
    everything = ("matched", "poses", "extrinsics", "gps")
    path, summary = placed(files, tmp_path / "out", *everything, gps_offset=-100.0)
    places = re.search(r"GPS \((\d+) of 400 positions\)", summary)
    assert places and int(places[1]) > 300 and ate(path.positions, truth, scaled=False) < 0.8 and error(path).max() < 6
    assert path.times == pytest.approx(drive.times)
    late, _ = placed(files, tmp_path / "late", *everything, gps_offset=-80.0, time_offset=20.0)
    assert late.times == pytest.approx(drive.times)  # in the clock of the sweeps


def test_sources_without_common_times_are_reported(tmp_path: Path) -> None:
    files = recorded(tmp_path, simulated(7, outliers=0))
    with pytest.raises(InputError, match=r"gps\.csv: spans 100\.00 to 139\.90 s, the sweeps 0\.00 to 39\.90 s.*offset"):
        placed(files, tmp_path / "a", "matched", "gps")
    with pytest.raises(InputError, match=r"camera\.csv: spans .*--time-offset"):
        placed(files, tmp_path / "b", "matched", "poses", time_offset=500.0)


def test_reversed_camera_is_detected(tmp_path: Path) -> None:
    files = recorded(tmp_path, simulated(8, outliers=0))
    np.savetxt(files["extrinsics"], inverse(simulated(8).T_camera_scanner)[:3])
    (tmp_path / "out").mkdir()
    done = fuse_path({k: v for k, v in files.items() if k != "gps"}, FuseParams(), tmp_path / "out", silent)
    assert any("contradict each other" in text for text in done.warnings)


def test_exact_relative_motions_alone_give_the_exact_path() -> None:
    drive = simulated(9, tunnel=(0, 0))
    exact = RelativeMotions(inverse(drive.truth[:-1]) @ drive.truth[1:], drive.lidar.covariance, drive.lidar.sure)
    found = fuse(drive.times, lidar=exact).trajectory.poses
    np.testing.assert_allclose(found, inverse(drive.truth[0]) @ drive.truth, atol=1e-3)
