"""Assembled clouds are checked by the times of their points, and aligned where passes disagree."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.api import import_clouds
from scan2sim.flows.cli import app
from scan2sim.pipeline.core.types import F64, Bools, Frame, Trajectory
from scan2sim.pipeline.importers.path_correction import PathCorrection, write_corrected
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.gps_time import clock_offsets
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.slam.trajectory import cloud_sections
from tests.fakes import sbet
from tests.fakes.two_passes import Passes, passes
from tests.flows.inline_steps import inline_steps
from tests.present import present

pytestmark = pytest.mark.usefixtures("steps_in_process")


@pytest.fixture(scope="module")
def drive() -> Passes:
    return passes()


def imported(folder: Path, *options: object) -> tuple[str, dict[str, object]]:
    """Output of the import, and content of the check."""
    words = (
        f"import clouds {folder}/cloud.laz --trajectory {folder}/path.csv --crs local --out {folder}/tile --overwrite"
    )
    result = CliRunner().invoke(app, [*words.split(), *map(str, options)])
    assert result.exit_code == 0, result.output
    return result.output, json.loads((folder / "tile" / "trajectory_check.json").read_text(encoding="utf-8"))


def test_passes_of_a_drifting_ins_agree_after_the_import(drive: Passes, tmp_path: Path) -> None:
    drive.assemble(tmp_path, drive.ins)
    photos = "file,x,y,z,qw,qx,qy,qz,time,width,height,fx\n"
    for i in (10, 40, 55):
        position = ",".join(f"{value:.6f}" for value in drive.ins[i, :3, 3])
        photos += f"{i}.png,{position},1,0,0,0,{'' if i == 55 else drive.times[i]},32,32,30\n"
        (tmp_path / f"{i}.png").touch()
    (tmp_path / "photos.csv").write_text(photos, encoding="utf-8")
    output, check = imported(tmp_path, "--photos", tmp_path / "photos.csv")
    assert "Poses corrected by matching the sections" in output and "1 photos have no time" in output
    assert check["pose_source"] == "fused"

    tile = read_tile(tmp_path / "tile")
    given = las.read(tmp_path / "cloud.laz", Frame())
    moved = clouds.read(tile.clouds[0], Frame())
    assert np.array_equal(present(given.intensity), present(moved.intensity))
    assert np.array_equal(present(given.time), present(moved.time))
    truth = np.concatenate([drive.sweep(i) @ T[:3, :3].T + T[:3, 3] for i, T in enumerate(drive.truth)])
    error = moved.xyz - truth
    near = np.linalg.norm(error, axis=1)
    assert np.median(np.linalg.norm(given.xyz - truth, axis=1)) > 0.1
    back = np.isin(present(moved.time), drive.times[drive.second])
    street = (truth[:, 0] > 3) & (truth[:, 0] < 33)  # scanned by both passes
    gaps = [error[street & back & at].mean(axis=0) - error[street & ~back & at].mean(axis=0) for at in cells(truth)]
    assert max(map(np.linalg.norm, gaps)) < 0.02 and np.median(near) < 0.2

    origin = np.asarray(tile.frame.origin)
    path = present(tile.trajectory).positions + origin
    assert np.linalg.norm(path.mean(axis=0) - drive.ins[:, :3, 3].mean(axis=0)) < 0.05  # the INS's georeference
    for view, i in zip(tile.views, (10, 40, 55), strict=True):
        assert np.linalg.norm(view.centre + origin - path[i]) < 0.01

    first = (tmp_path / "tile" / "cloud.laz").read_bytes()
    imported(tmp_path, "--photos", tmp_path / "photos.csv")
    assert (tmp_path / "tile" / "cloud.laz").read_bytes() == first


def cells(xyz: F64) -> list[Bools]:
    """Masks (N,) of cells along the street."""
    return [np.asarray((xyz[:, 0] >= low) & (xyz[:, 0] < low + 5)) for low in range(3, 33, 5)]


def test_clouds_that_agree_are_copied_unchanged_and_their_clock_is_recognized(drive: Passes, tmp_path: Path) -> None:
    week = 2300 * 604_800.0 - 1e9
    drive.assemble(tmp_path, drive.truth, clock_s=week)
    output, check = imported(tmp_path)
    assert "Poses as given: surfaces agree to" in output and check["clock_offset_s"] == week
    assert (tmp_path / "tile" / "cloud.laz").read_bytes() == (tmp_path / "cloud.laz").read_bytes()
    assert np.allclose(present(read_tile(tmp_path / "tile").trajectory).times, drive.times + week)
    assert not (tmp_path / "tile" / "trajectory_correction.csv").exists()
    plain = import_clouds(
        [tmp_path / "cloud.laz"], tmp_path / "given", trajectory=tmp_path / "path.csv", crs="local", pose_source="given"
    )
    assert (plain.parent / "trajectory.csv").read_bytes() == (tmp_path / "path.csv").read_bytes()


def test_reasons_why_a_cloud_is_not_checked_are_reported(drive: Passes, tmp_path: Path) -> None:
    drive.assemble(tmp_path, drive.truth, timed=False)
    assert "not checked: the points of cloud.laz have no GPS times" in " ".join(imported(tmp_path)[0].split())
    drive.assemble(tmp_path, drive.truth, clock_s=1234.5)
    assert "isn't the same time in another GPS or UNIX clock" in " ".join(imported(tmp_path)[0].split())
    far = drive.truth.copy()
    drive.assemble(tmp_path, far)
    table = np.loadtxt(tmp_path / "path.csv", delimiter=",", skiprows=1)
    np.savetxt(tmp_path / "path.csv", table + [0, 0, 0, 800], "%.3f", ",", header="time,x,y,z", comments="")
    assert "802 m above the lowest ones beside it: an airborne cloud, or heights" in " ".join(
        imported(tmp_path)[0].split()
    )


def test_heights_of_another_datum_are_reported(drive: Passes, tmp_path: Path) -> None:
    drive.assemble(tmp_path, drive.truth)
    table = np.loadtxt(tmp_path / "path.csv", delimiter=",", skiprows=1)
    np.savetxt(tmp_path / "path.csv", table + [0, 0, 0, 30], "%.3f", ",", header="time,x,y,z", comments="")
    output, check = imported(tmp_path)
    assert "the trajectory is 31.8 m above the lowest points beside it" in " ".join(output.split())
    assert check["scanner_height_m"] == pytest.approx(31.8, abs=0.1)


def test_sbet_file_of_the_scanner_is_projected(drive: Passes, tmp_path: Path) -> None:
    crs, origin, week = "EPSG:32632", np.array([458_000.0, 5_428_000.0, 100.0]), 2300 * 604_800.0 - 1e9
    drive.assemble(tmp_path, drive.truth, clock_s=week, frame=Frame(crs, tuple(origin.tolist())))
    poses = drive.truth.copy()
    poses[:, :3, 3] += origin
    sbet.write(tmp_path / "sbet.out", crs, drive.times, poses)
    given = f"import clouds {tmp_path}/cloud.laz --trajectory {tmp_path}/sbet.out --out {tmp_path}"
    for name, options in (("auto", ""), ("given", "--pose-source given")):
        result = CliRunner().invoke(app, f"{given}/{name} {options}")
        assert result.exit_code == 0, result.output
        tile = read_tile(tmp_path / name)
        path = present(tile.trajectory)
        assert np.abs(path.positions + np.asarray(tile.frame.origin) - poses[:, :3, 3]).max() < 1e-3
        assert np.allclose(path.times, drive.times + (week if name == "auto" else 0))
        assert np.allclose(present(path.rotations), poses[:, :3, :3], atol=1e-4)


def test_failing_check_of_a_cloud_costs_only_itself(
    drive: Passes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive.assemble(tmp_path, drive.ins)
    monkeypatch.setattr(cloud_sections, "read", lambda *_: 1 / 0)
    with inline_steps():
        output, check = imported(tmp_path)
        required = CliRunner().invoke(
            app, f"import clouds {tmp_path}/cloud.laz --trajectory {tmp_path}/path.csv --crs local --pose-source fused "
            f"--out {tmp_path}/fused",
        )  # fmt: skip
    assert "warning: the poses couldn't be checked against the cloud (ZeroDivisionError" in " ".join(output.split())
    assert check["pose_source"] == "given"
    assert (tmp_path / "tile" / "cloud.laz").read_bytes() == (tmp_path / "cloud.laz").read_bytes()
    assert required.exit_code != 0 and not (tmp_path / "fused").exists()


@pytest.mark.parametrize("other", ["adjusted", "gps", "week", "day", "unix"])
@pytest.mark.parametrize("own", ["adjusted", "gps", "week", "day", "unix"])
def test_offsets_between_common_clocks_are_candidates(own: str, other: str) -> None:
    gps = 1.4e9 + 1234.5
    clocks = {"adjusted": gps - 1e9, "gps": gps, "week": gps % 604_800, "day": gps % 86_400, "unix": gps + 315_964_782}
    offsets = [0.0, *clock_offsets(clocks[own], clocks[other] + 40)]
    assert np.abs(clocks[other] + np.array(offsets) - clocks[own]).min() < 1e-6


def test_a_cloud_in_feet_keeps_its_attributes_when_it_is_corrected(tmp_path: Path) -> None:
    import laspy

    header = laspy.LasHeader(version="1.2", point_format=3)
    header.scales, header.offsets = np.full(3, 0.001), np.array([1e6, 2e6, 0])
    header.add_extra_dim(laspy.ExtraBytesParams(name="range", type=np.float32))
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.array([[1e6, 2e6, 0.0], [1e6 + 10, 2e6, 0], [1e6, 2e6 + 5, 3]]).T
    cloud.gps_time, cloud.red, cloud["range"] = np.array([0.0, 1.0, 99.0]), np.array([1, 2, 3]), [7.0, 8.0, 9.0]
    cloud.user_data[:] = 5
    cloud.write(tmp_path / "cloud.las")
    foot = 0.3048
    path = Trajectory(np.array([0.0, 1.0]), np.array([[1e6, 2e6, 0], [1e6 + 10, 2e6, 0]]) * foot)
    shift = np.array([[0.0, 0, 0], [0, 0.3048, 0]])
    correction = PathCorrection(path, path.times, shift, np.array([[0, 0, np.pi / 2], [0, 0, 0]]))
    write_corrected(tmp_path / "cloud.las", tmp_path / "out.laz", correction, Frame(unit=foot))
    out = laspy.read(tmp_path / "out.laz")
    assert np.allclose(out.xyz, [[1e6, 2e6, 0], [1e6 + 10, 2e6 + 1, 0], [1e6, 2e6 + 5, 3]], atol=2e-3)  # 99 s: no pose
    assert out["range"].tolist() == [7, 8, 9] and out.red.tolist() == [1, 2, 3] and set(out.user_data) == {5}
    assert out.header.version == cloud.header.version and out.header.point_format.id == 3
    assert out.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
