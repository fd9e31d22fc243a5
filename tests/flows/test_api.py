"""The public Python API, used as in a notebook."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scan2sim
from scan2sim.flows.commands import survey as survey_command
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.errors import EXIT_CODES
from tests.conftest import ROOT
from tests.fakes import synthetic
from tests.flows.tiny import COARSE, tiny


def test_api_names_exist() -> None:
    assert all(getattr(scan2sim, name) for name in scan2sim.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        scan2sim.no_such_name  # noqa: B018


def test_shells_and_notebooks_complete_names_that_are_not_loaded_yet() -> None:
    code = "import scan2sim; print(*dir(scan2sim), 'scan2sim.flows.api' in __import__('sys').modules)"
    words = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert {*scan2sim.__all__, "False"} <= set(words.split())


def test_every_documented_error_can_be_caught_by_its_name() -> None:
    kinds = {kind for kind in EXIT_CODES if issubclass(kind, scan2sim.ScanError)} | {scan2sim.ScanError}
    assert {getattr(scan2sim, kind.__name__) for kind in kinds} == kinds
    page = (ROOT / "docs/reference/python.md").read_text(encoding="utf-8")
    assert {kind.__name__ for kind in kinds} == set(re.findall(r"\b[A-Z]\w+Error\b", page))


def test_settings_may_be_nested_or_dotted() -> None:
    nested = Settings.of({"decimate": {"target": 1, "building": {"target": 2}}})
    assert Settings.of({"decimate.target": 1, "decimate.building.target": 2}).values == nested.values
    with pytest.raises(scan2sim.ScanError, match=r"step\.param"):
        Settings.of({"decimate.building.target.x": 1})


def test_settings_of_a_loop_may_be_numbers_of_numpy_and_paths() -> None:
    values = Settings.of({"decimate.target": np.int64(50_000), "segment": {"model": Path("a"), "x": (np.float32(1),)}})
    assert json.loads(json.dumps(values.values)) == values.values
    assert values.values == {"decimate": {"target": 50_000}, "segment": {"model": "a", "x": [1.0]}}


def test_dotted_and_nested_settings_of_one_step_are_merged() -> None:
    dotted_first = Settings.of({"decimate.building.target": 2, "decimate": {"target": 1}})
    nested_first = Settings.of({"decimate": {"target": 1}, "decimate.building.target": 2})
    assert dotted_first.values == nested_first.values == {"decimate": {"target": 1, "building": {"target": 2}}}


@pytest.mark.parametrize("wrong", [{"jobs": -1}, {"hold_out": -8}, {"length": 0.0}, {"buffer": -1.0}])
def test_numbers_out_of_range_are_rejected_before_anything_runs(wrong: dict[str, Any], tmp_path: Path) -> None:
    """All cores are `jobs=0`; with the -1 of other libraries no step would start, for ever."""
    function = "survey" if {"length", "buffer"} & wrong.keys() else "run"
    with pytest.raises(scan2sim.ScanError, match=rf"{function}\.{next(iter(wrong))}: must be"):
        getattr(scan2sim, function)(tmp_path / "tile", tmp_path / "out", progress=False, **wrong)
    assert not (tmp_path / "out").exists()


def test_run_returns_a_readable_world(small_street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tile = tiny(small_street, tmp_path / "tile")
    world = scan2sim.run(tile, tmp_path / "out", COARSE, progress=False)
    assert capsys.readouterr().out == ""
    assert (
        world.sdf.is_file() and world.report["geometry"] and world.scene.tiles[0].groups["building"]["triangles"] > 10
    )
    assert scan2sim.read_world(str(tmp_path / "out")).sdf == world.sdf


def test_errors_have_place_cause_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(scan2sim.ScanError) as caught:
        scan2sim.run(tmp_path / "nothing", tmp_path / "out")
    assert caught.value.where and caught.value.cause and caught.value.remedy
    with pytest.raises(scan2sim.ScanError, match="there is no such step"):
        scan2sim.survey(tmp_path, tmp_path / "out", {"carving.when": "never"})
    with pytest.raises(scan2sim.ScanError):
        scan2sim.read_world(tmp_path)


def test_a_world_is_found_after_a_change_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthetic.scene(tmp_path / "my_world")
    monkeypatch.chdir(tmp_path)
    world = scan2sim.read_world("my_world")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert world.folder == tmp_path / "my_world" and world.sdf.is_absolute()
    assert all(len(shape) for shape in world.scene.tiles[0].textured().values())


def test_the_folder_world_alone_is_a_world(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path / "my_world")
    (inner,) = {tile.folder.parents[1] for tile in scene.tiles}
    assert scan2sim.read_world(inner).sdf == scan2sim.read_world(tmp_path / "my_world").sdf
    assert scan2sim.read_world(inner).sdf == inner / f"{scene.name}.sdf"


def test_the_world_of_a_survey_in_object_storage_is_its_copy_on_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synthetic.scene(tmp_path)
    monkeypatch.setattr(survey_command, "run_source", lambda *_, **__: tmp_path / "survey.html")
    assert scan2sim.survey("s3://bucket/survey", "s3://bucket/worlds").folder == tmp_path
