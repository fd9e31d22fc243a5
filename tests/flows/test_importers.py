"""Importers of the Python API: paths as text, options and results of the commands, silence, and warnings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import scan2sim
from scan2sim.flows.cli import app, loaded
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.io import photogrammetry
from scan2sim.pipeline.io.tile import read_tile
from tests.conftest import ROOT
from tests.fakes.datasets import Drive, write_pandaset
from tests.flows.inline_steps import inline_steps
from tests.pipeline.importers.bag.test_unpack import SWEEPS, write
from tests.pipeline.importers.test_clouds_and_photos import CAMERA, VALUES, cloud, photos
from tests.pipeline.importers.test_kitti_odometry import make_sequence
from tests.pipeline.importers.test_kitti_raw import FRAMES, make_drive
from tests.pipeline.importers.test_robot_map import room, save
from tests.present import present

PAGE = (ROOT / "docs/reference/python.md").read_text(encoding="utf-8")
RECORDINGS = ("bag", "sweeps", "nuscenes", "pandaset", "images")


@pytest.fixture(autouse=True)
def _inline_steps() -> Iterator[None]:
    with inline_steps():
        yield


def test_every_import_of_the_command_line_is_a_function() -> None:
    commands = {word for word, command in loaded("import").commands.items() if not command.hidden}
    programs = set(plugins.names(photogrammetry.__name__))
    functions = {name[7:].replace("_", "-") for name in scan2sim.__all__ if name.startswith("import_")}
    assert functions - {"photogrammetry"} == commands - programs and programs <= commands


def test_the_import_on_the_page_takes_text_relative_to_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (line,) = re.findall(r"^tile = scan2sim\.import_clouds\(.*\)$", PAGE, re.MULTILINE)
    cloud(tmp_path / "survey.laz")
    photos(tmp_path, f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"1.png,500010,5400005,102,1,0,0,0,{VALUES}")
    monkeypatch.chdir(tmp_path)
    names = {"scan2sim": scan2sim}
    exec(line, names)
    monkeypatch.chdir(tmp_path.parent)
    tile = Path(str(names["tile"]))
    assert tile == tmp_path / "my_tile" / "tile.toml" and len(read_tile(tile).views) == 1


def test_a_single_cloud_is_not_a_list_of_letters(tmp_path: Path) -> None:
    source = str(cloud(tmp_path / "survey.laz"))
    assert [one.name for one in read_tile(scan2sim.import_clouds(source, tmp_path / "tile")).clouds] == ["survey.laz"]


def test_clouds_with_other_axes_are_imported_with_their_trajectory(tmp_path: Path) -> None:
    """It can't be checked against them, as the command knows, too."""
    path = tmp_path / "path.csv"
    path.write_text("time,x,y,z\n0,500000,5400000,101\n1,500010,5400010,101\n", encoding="utf-8")
    source = cloud(tmp_path / "survey.laz")
    tile = scan2sim.import_clouds([source], tmp_path / "tile", trajectory=str(path), axes="neh", crs="local")
    assert len(present(read_tile(tile).trajectory)) == 2


def test_warnings_are_printed_or_passed_on_and_a_quiet_import_prints_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heading = f"file,x,y,z,qw,qx,qy,qz,{CAMERA},weather"
    sheet = photos(tmp_path, heading, f"1.png,500010,5400005,102,1,0,0,0,{VALUES},rain")
    source, found = cloud(tmp_path / "survey.laz"), list[str]()
    scan2sim.import_clouds(source, tmp_path / "quiet", photos=sheet, progress=False, warn=found.append)
    assert any("weather" in text for text in found) and capsys.readouterr().out == ""
    scan2sim.import_clouds(source, tmp_path / "shown", photos=sheet)
    printed = "".join(capsys.readouterr().out.split())
    assert all("".join(text.split()) in printed for text in found)


def test_conventions_of_poses_have_the_names_of_the_options(tmp_path: Path) -> None:
    sheet = photos(tmp_path, f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"1.png,500010,5400005,102,1,0,0,0,{VALUES}")
    source = cloud(tmp_path / "survey.laz")
    conventions = {"camera_axes": "opengl"}
    tile = scan2sim.import_clouds(source, tmp_path / "tile", photos=sheet, conventions=conventions)
    assert np.allclose(read_tile(tile).views[0].T_world_cam[:3, :3], np.diag([1, -1, -1]))
    with pytest.raises(scan2sim.SettingError, match=r"conventions\.axes: unknown setting"):
        scan2sim.import_clouds(source, tmp_path / "other", photos=sheet, conventions={"axes": "opengl"})


def test_a_bag_becomes_the_tile_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write(tmp_path / "bag")
    out = str(tmp_path / "python" / "tile")
    tile = scan2sim.import_bag(str(bag), out, progress=False, deskew="none", min_range=0)
    assert capsys.readouterr().out == "" and len(read_tile(tile).views) == SWEEPS
    other = tmp_path / "command" / "tile"
    words = ["import", "bag", bag, "--out", other, "--deskew", "none", "--min-range", 0]
    assert CliRunner().invoke(app, [str(word) for word in words]).exit_code == 0
    assert tile.read_bytes() == (other / "tile.toml").read_bytes()


def test_a_sequence_of_pandaset_is_imported_with_options(tmp_path: Path) -> None:
    folder = write_pandaset(tmp_path / "001", Drive())
    tile = scan2sim.import_pandaset(str(folder), tmp_path / "out" / "tile", camera=["none"], crs="local")
    assert not read_tile(tile).views and tile.parent == tmp_path / "out" / "tile"


def test_drives_of_kitti_take_text_and_the_name_of_a_single_camera(tmp_path: Path) -> None:
    drive, sequence = str(make_drive(tmp_path).folder), str(make_sequence(tmp_path))
    raw = scan2sim.import_kitti_raw(drive, str(tmp_path / "raw"), cameras="image_02", pose_source="given")
    odometry = scan2sim.import_kitti_odometry(sequence, str(tmp_path / "odometry"), cameras="image_2", frames=(0, 2))
    assert len(read_tile(raw).views) == FRAMES and len(read_tile(odometry).views) == 3
    with pytest.raises(scan2sim.SettingError, match=r"import_kitti_raw\.max_range: must be"):
        scan2sim.import_kitti_raw(drive, tmp_path / "other", max_range=-1)


def test_a_map_is_imported_with_its_axis_and_unit(tmp_path: Path) -> None:
    turn = Rotation.from_euler("x", -90, degrees=True)  # its y axis points up
    save(tmp_path / "map.las", np.asarray(turn.apply(room()) * 100, np.float32))
    tile = scan2sim.import_map(str(tmp_path / "map.las"), str(tmp_path / "tile"), up="y", units="cm")
    found = present(read_tile(tile).robot_map)
    assert found.unit == 0.01 and np.allclose(found.T_world_map[2, :3], [0, 1, 0], atol=0.02)


@pytest.mark.parametrize("kind", [*RECORDINGS, "map"])
def test_unknown_options_and_missing_sources_are_errors(kind: str, tmp_path: Path) -> None:
    function = getattr(scan2sim, f"import_{kind}")
    with pytest.raises(scan2sim.SettingError, match=rf"import_{kind}\.max_rnge: unknown setting.*import {kind} --help"):
        function("nowhere", tmp_path / "tile", max_rnge=30)
    with pytest.raises(scan2sim.ScanError):
        function("nowhere", tmp_path / "tile", progress=False)
    assert not (tmp_path / "tile").exists()


@pytest.mark.parametrize("kind", RECORDINGS)
def test_an_existing_tile_is_kept_before_any_step_runs(kind: str, tmp_path: Path) -> None:
    (tmp_path / "tile").mkdir()
    (tmp_path / "tile" / "mine.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(scan2sim.SettingError, match="not empty"):
        getattr(scan2sim, f"import_{kind}")("nowhere", tmp_path / "tile", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["tile"]
