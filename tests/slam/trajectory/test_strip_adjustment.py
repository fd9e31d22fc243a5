"""Paths are checked against the sweeps, and corrected where that makes surfaces agree clearly better."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.pipelines.kitti import import_kitti_odometry, import_kitti_raw
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.kitti_raw import read_poses
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.slam import scan_pairs
from scan2sim.slam.geometry import exp_so3, inverse
from scan2sim.slam.scan_pairs import register, select, surface_of
from scan2sim.slam.trajectory.strip_adjustment import PoseSource, adjust, corrected
from tests.fakes.two_passes import Passes, passes
from tests.flows.inline_steps import inline_steps
from tests.present import present

pytestmark = pytest.mark.usefixtures("steps_in_process")


@pytest.fixture(scope="module")
def drive() -> Passes:
    return passes()


def test_passes_and_neighbours_of_a_drifting_ins_agree_after_the_adjustment(drive: Passes, tmp_path: Path) -> None:
    assert np.median(drive.gap(drive.ins)) > 0.1
    drive.write(tmp_path, drive.ins)
    command = f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.csv --out {tmp_path}/tile"
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0 and "Poses corrected by matching the sweeps" in result.output, result.output
    path = present(read_tile(tmp_path / "tile").trajectory)
    origin = np.asarray(read_tile(tmp_path / "tile").frame.origin)
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = present(path.rotations), path.positions + origin
    gap = drive.gap(poses)
    assert np.median(gap) < 0.01 and gap.max() < 0.03
    assert drive.offset(poses) < 0.2  # the INS's own error
    check = json.loads((tmp_path / "tile" / "trajectory_check.json").read_text(encoding="utf-8"))
    assert check["pose_source"] == "fused" and not check["unsure_s"]
    assert check["before"]["passes_m"] > 0.1 > 0.02 > check["after"]["passes_m"]
    table = np.loadtxt(tmp_path / "tile" / "trajectory_correction.csv", delimiter=",", skiprows=1)
    assert np.allclose(drive.ins[:, :3, 3] + table[:, 1:4], poses[:, :3, 3], atol=2e-3)


def test_poses_that_agree_with_the_sweeps_are_kept(drive: Passes, tmp_path: Path) -> None:
    drive.write(tmp_path, drive.truth, 12)
    result = CliRunner().invoke(
        app, f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.csv --out {tmp_path}/tile --scanner-poses"
    )
    assert result.exit_code == 0 and "Poses as given: surfaces agree" in result.output, result.output
    tile = read_tile(tmp_path / "tile")
    positions = present(tile.trajectory).positions + np.asarray(tile.frame.origin)
    assert np.abs(positions - drive.truth[:12, :3, 3]).max() < 1e-5
    assert not (tmp_path / "tile" / "trajectory_correction.csv").exists()


def test_given_poses_are_not_checked_on_request(drive: Passes, tmp_path: Path) -> None:
    drive.write(tmp_path, drive.ins, 4)
    command = f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.csv --out {tmp_path}/tile --pose-source given"
    assert CliRunner().invoke(app, command).exit_code == 0
    assert not (tmp_path / "tile-path").exists() and not (tmp_path / "tile" / "trajectory_check.json").exists()
    wrong = CliRunner().invoke(app, f"import kitti-raw {tmp_path} --out {tmp_path}/b --pose-source icp")
    assert re.search(r"--pose-source.*given, auto or fused", str(wrong.exception))


def test_poses_of_another_convention_are_reported_and_not_corrected(drive: Passes, tmp_path: Path) -> None:
    on_its_side = drive.ins.copy()
    on_its_side[:, :3, :3] = drive.ins[:, :3, :3] @ exp_so3([np.pi / 2, 0, 0])
    drive.write(tmp_path, on_its_side, 6)
    command = f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.csv --out {tmp_path}/tile"
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0 and "z axis doesn't point upwards" in result.output, result.output
    check = json.loads((tmp_path / "tile" / "trajectory_check.json").read_text(encoding="utf-8"))
    assert check["pose_source"] == "given"


@pytest.mark.parametrize(("turn", "named"), [(0.0, "points upwards"), (1.7, "sweeps disagree by")])
def test_another_quaternion_order_is_detected(drive: Passes, tmp_path: Path, turn: float, named: str) -> None:
    world = np.eye(4)
    world[:3, :3] = exp_so3([0, 0, turn])
    truth = world @ drive.truth
    drive.write(tmp_path, truth, 8)
    trajectory_io.write(tmp_path / "xyzw.tum", trajectory_io.read(tmp_path / "poses.csv"))
    rows = np.loadtxt(tmp_path / "xyzw.tum")
    np.savetxt(tmp_path / "poses.tum", np.column_stack([rows[:, :4], rows[:, 7], rows[:, 4:7]]), "%.9f")
    command = f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.tum --out {tmp_path}/tile --overwrite"
    output = " ".join(CliRunner().invoke(app, command).output.split())
    assert output.count("quaternions of the trajectory look like w,x,y,z: with `--quaternions wxyz`") == 1
    assert named in output
    fixed = CliRunner().invoke(app, f"{command} --quaternions wxyz")
    assert fixed.exit_code == 0 and "--quaternions" not in fixed.output, fixed.output
    path = present(read_tile(tmp_path / "tile").trajectory)
    assert np.allclose(present(path.rotations), truth[:8, :3, :3], atol=1e-6)


def test_sweeps_without_common_surfaces_keep_their_poses(drive: Passes) -> None:
    def sparse(i: int, path: object) -> F64:
        return drive.sweep(i)[:5]

    kept = adjust(drive.times[:8], drive.ins[:8], sparse, report=silent)
    assert kept.source == "given" and np.array_equal(kept.poses, drive.ins[:8]) and not kept.warnings()
    assert "overlap too little" in kept.summary()
    still = np.repeat(drive.ins[:1], 5, axis=0)
    assert adjust(drive.times[:5], still, lambda i, _: drive.sweep(0), report=silent).source == "given"


def test_failing_check_is_a_warning_and_costs_only_itself(
    drive: Passes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive.write(tmp_path, drive.ins, 6)
    monkeypatch.setattr(scan_pairs, "compare", lambda *_, **__: 1 / 0)
    command = f"import sweeps {tmp_path}/sweeps {tmp_path}/poses.csv --out {tmp_path}/tile"
    with inline_steps():
        result = CliRunner().invoke(app, command)
        required = CliRunner().invoke(app, f"{command}_2 --pose-source fused")
    assert result.exit_code == 0, result.exception
    output = " ".join(result.output.split())
    assert "warning: the poses couldn't be checked against the sweeps (ZeroDivisionError: division by zero)" in output
    tile = read_tile(tmp_path / "tile")
    positions = present(tile.trajectory).positions + np.asarray(tile.frame.origin)
    assert np.abs(positions - drive.ins[:6, :3, 3]).max() < 1e-5 and tile.clouds
    check = json.loads((tmp_path / "tile" / "trajectory_check.json").read_text(encoding="utf-8"))
    assert check["pose_source"] == "given" and "not checked: ZeroDivisionError" in check["summary"]
    assert required.exit_code != 0 and not (tmp_path / "tile_2").exists()


def test_unreadable_sweeps_are_no_failure_of_the_check(drive: Passes) -> None:
    def damaged(i: int, path: object) -> F64:
        raise InputError(Path("000001.ply"), "is damaged", "Copy it again")

    with pytest.raises(InputError, match="is damaged"):
        adjust(drive.times[:8], drive.ins[:8], damaged, report=silent)


def test_poses_that_still_disagree_are_reported(drive: Passes) -> None:
    checked = adjust(drive.times[:14], drive.ins[:14], lambda i, _: drive.sweep(i), "given", report=silent)
    assert checked.source == "given" and "--pose-source auto" in checked.warnings()[0]
    unimproved = replace(checked, after=checked.before)
    assert "time stamps" in unimproved.warnings()[0] and "doesn't improve" in unimproved.summary()
    corrected_partly = replace(unimproved, source="fused", unsure=np.arange(14) // 4 == 1)
    assert "29 % of the sweeps" in corrected_partly.warnings()[0]
    assert corrected_partly.figures(drive.times[:14])["unsure_s"] == [[0.4, 0.7]]


def test_registration_keeps_unconstrained_directions() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-15, 15, (8000, 2)), rng.normal(-1.8, 0.005, 8000)])
    start = np.eye(4)
    start[:3, 3] = [0.3, -0.2, 0.1]
    found = present(register(ground, surface_of(ground), start))
    assert abs(found.T[2, 3]) < 0.005 and np.allclose(found.T[:2, 3], [0.3, -0.2], atol=1e-3)
    sigma = np.sqrt(np.diagonal(found.covariance))
    assert sigma[:2].min() > 1 > 0.02 > sigma[2]
    assert register(ground + [100, 0, 0], surface_of(ground), np.eye(4)) is None


def test_selected_pairs_are_neighbours_and_other_passes() -> None:
    out = np.column_stack([np.arange(0, 40.0), np.zeros(40), np.zeros(40)])
    first, second, far = select(np.concatenate([out, out[::-1] + [0, 3.0, 0]]))
    assert far.any() and (second > first).all()
    assert (second[~far] - first[~far] < 7).all() and (second[far] - first[far] > 28).all()


def test_correction_is_interpolated_between_sweeps() -> None:
    times = np.linspace(0, 1, 11)
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = times**2  # the path's own shape remains
    moved = poses[[0, 10]].copy()
    moved[1, 1, 3] += 0.4
    out = corrected(times, poses, times[[0, 10]], poses[[0, 10]], moved)
    assert np.allclose(out[:, 1, 3], 0.4 * times) and np.allclose(out[:, 0, 3], times**2)


def test_kitti_oxts_is_corrected_to_the_poses_of_scan_matching(real_data: Path, tmp_path: Path) -> None:
    source = real_data / "kitti_raw0009_f00-24"
    icp = read_poses(source / "T_velo0_velo_icp_frames_0-24.txt", list(range(25)))
    errors = dict[str, F64]()
    sources: tuple[PoseSource, ...] = ("given", "auto")
    for name in sources:
        tile = read_tile(import_kitti_raw(source, tmp_path / name, pose_source=name, link=True))
        views = np.stack([view.T_world_cam for view in tile.views])
        errors[name] = inverse(views[0]) @ views[-1]
    check = json.loads((tmp_path / "auto" / "trajectory_check.json").read_text(encoding="utf-8"))
    assert check["before"]["neighbours_m"] > 0.06 and check["after"]["neighbours_m"] < 0.015
    # the camera looks along the scanner's x axis: sideways is x of the camera, y of the scanner
    sideways = {name: abs(T[0, 3] + icp[-1, 1, 3]) for name, T in errors.items()}
    assert sideways["auto"] < 0.12 < 0.25 < sideways["given"]


def test_ground_truth_of_an_ins_is_corrected(real_data: Path, tmp_path: Path) -> None:
    tile = import_kitti_odometry(real_data / "kitti_odo04_f00-24", tmp_path / "tile", frames=(0, 14), link=True)
    check = json.loads((tile.parent / "trajectory_check.json").read_text(encoding="utf-8"))
    assert check["pose_source"] == "fused" and check["before"]["neighbour_pairs"] > 5
    assert check["before"]["neighbours_m"] > 0.03 and check["after"]["neighbours_m"] < 0.015
