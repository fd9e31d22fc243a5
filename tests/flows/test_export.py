"""`scan2sim export`: conversion to other formats, budgets, and rejected options."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

import scan2sim
from scan2sim.flows.cli import app
from scan2sim.flows.commands.budget import parse_budget
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import world_formats
from tests.fakes import synthetic
from tests.pipeline.io.test_robots import driven


def run(*words: object) -> str:
    done = CliRunner().invoke(app, ["export", *map(str, words)])
    if done.exception is not None:
        raise done.exception
    return done.output


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_export_equals_the_world_of_the_pipeline(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    run(world, "--to", "gazebo,glb", "--out", tmp_path / "out")
    own = {name: data for name, data in files(world).items() if not name.startswith("scene/")}
    assert files(tmp_path / "out") == own


def test_simplified_meshes_need_no_space_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = synthetic.world(tmp_path).files["world"]
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    run(world, "--to", "tiles3d", "--out", tmp_path / "out", "--levels", 2)
    assert not [name for name in files(tmp_path / "out") if name.startswith(".")]


def test_export_in_python_equals_that_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = synthetic.world(tmp_path).files["world"]
    out = scan2sim.export(str(world), "gazebo, glb", str(tmp_path / "python"), progress=False)
    assert capsys.readouterr().out == ""
    run(world, "--to", "gazebo,glb", "--out", tmp_path / "command")
    assert out == tmp_path / "python" and files(out) == files(tmp_path / "command")
    opened = scan2sim.read_world(world)
    few = scan2sim.export(opened, ["glb"], tmp_path / "few", budget="triangles=1k", overwrite=True, progress=False)
    assert (few / "street.glb").is_file() and not (few / "street.sdf").exists()
    with pytest.raises(SettingError, match=r"export\.page: unknown setting"):
        scan2sim.export(opened, "glb", tmp_path / "wrong", page="jpeg")
    with pytest.raises(SettingError, match=r"export\.levels: must be"):
        scan2sim.export(opened, "glb", tmp_path / "wrong", levels=9)


def test_foreign_folders_are_never_overwritten(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine", encoding="utf-8")
    for more in ((), ("--overwrite",)):
        with pytest.raises(SettingError, match="not empty|is not a world"):
            run(world, "--to", "glb", "--out", out, *more)
    assert files(out) == {"mine.txt": b"mine"}
    run(world, "--to", "glb", "--out", tmp_path / "new")
    run(world, "--to", "gazebo", "--out", tmp_path / "new", "--overwrite")
    assert (tmp_path / "new" / "street.sdf").is_file() and not (tmp_path / "new" / "street.glb").exists()


def test_unknown_format_lists_available_ones(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    for to in ("unreal", "glb,unreal", ","):
        with pytest.raises(SettingError) as caught:
            run(world, "--to", to, "--out", tmp_path / "out")
        assert all(name in caught.value.remedy for name in world_formats.format_names())
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="contains no world"):
        run(tmp_path / "tile", "--to", "glb", "--out", tmp_path / "out")


def test_carla_map_without_roads_is_a_warning(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    assert "CARLA's map has no OpenDRIVE" in run(world, "--to", "carla", "--out", tmp_path / "out").replace("\n", " ")
    assert "CARLA" not in run(world, "--to", "glb", "--out", tmp_path / "glb")


def test_world_without_crs_is_a_warning(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, frame=Frame()).files["world"]
    assert "has no CRS" in run(world, "--to", "glb", "--out", tmp_path / "out")


@pytest.mark.parametrize("text", ["triangles", "triangles=many", "triangles=10", "faces=20k", "texture=1.2.3MP"])
def test_invalid_budget_is_a_setting_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(SettingError, match="--budget"):
        run(tmp_path, "--to", "glb", "--out", tmp_path / "out", "--budget", text)


def test_world_is_simplified_to_the_budget(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    run(world, "--to", "glb", "--out", tmp_path / "out", "--budget", "triangles=1k,texture=0.1MP")
    groups = json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))["groups"].values()
    assert 500 < sum(group["triangles"] for group in groups) <= 1050
    assert parse_budget("triangles=200k, texture=64MP") == (200_000, 64e6) and parse_budget(None) == (None, None)


def test_borders_that_exceed_the_budget_are_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "ground", partial(synthetic.ground, 300))  # 1,200 edges all around
    world = synthetic.world(tmp_path).files["world"]
    printed = run(world, "--to", "glb", "--out", tmp_path / "out", "--budget", "triangles=1k")
    assert "can't be simplified" in printed


def test_robot_is_added_to_a_simplified_world(tmp_path: Path) -> None:
    driven(synthetic.scene(tmp_path, tiles=1))
    run(tmp_path, "--to", "urdf", "--out", tmp_path / "out", "--robot", "--budget", "triangles=1k")
    assert json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))["robot"]["on"] == "path"
    assert (tmp_path / "out" / "robot.urdf").is_file()


def test_3d_tiles_have_levels_of_detail(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    run(world, "--to", "tiles3d", "--out", tmp_path / "out", "--levels", 2)
    tileset = json.loads((tmp_path / "out" / "tileset.json").read_text(encoding="utf-8"))
    coarse, (fine,) = tileset["root"], tileset["root"]["children"]
    assert (coarse["refine"], coarse["content"]["uri"]) == ("REPLACE", "tiles3d/level1/street.glb")
    assert tileset["geometricError"] > coarse["geometricError"] > fine["geometricError"] == 0
    files = json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    assert files[coarse["content"]["uri"]] < files[fine["content"]["uri"]] / 2
