"""Preparation of a survey from drives and corridors, and which steps run again."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.commands.drive import PREPARED, plan_drive
from scan2sim.flows.commands.drive import survey_of as prepare_survey
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.pipelines.drive import Drive
from scan2sim.pipeline.core.errors import BusyError, InputError, LowConfidenceError
from scan2sim.pipeline.io.survey import read_survey
from scan2sim.pipeline.steps.cut import CUT
from scan2sim.pipeline.steps.import_sweeps import IMPORT_SWEEPS
from tests.flows.inline_steps import execute


def survey_of(place: Path | str, out: Path, **how: Any) -> str:
    return prepare_survey(place, out, lambda planned, store: execute(planned, store, on_event=lambda *_: None), **how)


@pytest.fixture
def corridor(small_street: Path, tmp_path: Path) -> Path:
    shutil.copytree(small_street, tmp_path / "corridor")
    return tmp_path / "corridor"


def drive(folder: Path, text: str) -> Path:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_corridor_is_cut_again_only_if_it_changes(corridor: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def cut(**how: Any) -> tuple[Path, int]:
        survey = Path(survey_of(corridor, out, **how))
        assert (out / "prepared" / "survey" / "survey.toml").samefile(survey)
        return survey, survey.stat().st_ino

    first = cut(length=6.0, buffer=2.0)
    assert len(read_survey(first[0]).tiles) == 2
    assert cut(length=6.0, buffer=2.0) == first
    finer = cut(length=4.0, buffer=1.0)
    assert len(read_survey(finer[0]).tiles) > 2 and not first[0].exists()
    text = (corridor / "tile.toml").read_text(encoding="utf-8")
    (corridor / "tile.toml").write_text(text.replace('name = "street"', 'name = "road"'), encoding="utf-8")
    other = cut(length=4.0, buffer=1.0)
    assert other != finer and read_survey(other[0]).name == "road"


def test_options_override_the_tile_length_of_a_drive(corridor: Path, tmp_path: Path) -> None:
    drive(tmp_path, 'corridor = "corridor"\n[tiles]\nlength = 6.0\nbuffer = 1.0\n')
    assert len(read_survey(Path(survey_of(tmp_path, tmp_path / "out"))).tiles) == 2
    assert len(read_survey(Path(survey_of(tmp_path, tmp_path / "out", length=4.0))).tiles) > 2


def test_new_step_versions_and_changed_files_rerun_steps_of_a_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("video.mp4", "lens.yaml", "camera.toml", "velodyne/0.bin", "image/0.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name, encoding="utf-8")
    text = '[slam]\nvideo = "video.mp4"\ncamera = "lens.yaml"\n[sweeps]\nfolder = "velodyne"\nphotos = "image"\n'
    text += 'camera = "camera.toml"\n'
    place, known = drive(tmp_path, text), dict[str, str]()

    def changed() -> set[str]:
        keys = {item.task.id.name: item.key for item in plan_drive(place, tmp_path / "out")[0]}
        others = {name for name, key in keys.items() if known.get(name) != key}
        known.update(keys)
        return others

    assert changed() == {"track", "georeference", "strip_adjustment", "import_sweeps", "cut"} and changed() == set()
    for step in (CUT, IMPORT_SWEEPS):
        pipeline = "drive" if step is CUT else "sweeps"
        monkeypatch.setattr(f"scan2sim.flows.pipelines.{pipeline}.{step.name.upper()}", replace(step, version=1000))
        assert changed() == ({"cut"} if step is CUT else {"import_sweeps", "cut"})
    for name in ("camera.toml", "velodyne/0.bin", "image/0.png"):
        (tmp_path / name).write_text("another", encoding="utf-8")
        checked = {"strip_adjustment"} if name.startswith("velodyne") else set()
        assert changed() == {"import_sweeps", "cut"} | checked, name
    (tmp_path / "velodyne/1.bin").write_text("one more", encoding="utf-8")
    assert changed() == {"strip_adjustment", "import_sweeps", "cut"}
    for name in ("video.mp4", "lens.yaml"):
        (tmp_path / name).write_text("another", encoding="utf-8")
        assert changed() == {"track", "georeference", "strip_adjustment", "import_sweeps", "cut"}


def test_plan_of_a_drive(corridor: Path, tmp_path: Path) -> None:
    place = drive(tmp_path, 'corridor = "corridor"\n[tiles]\nlength = 6.0\nbuffer = 1.0\n')

    def printed() -> str:
        return CliRunner().invoke(app, ["plan", str(place), "--out", str(tmp_path / "out")]).output

    assert re.search(r"cut +yes +never run before", printed())
    survey_of(place, tmp_path / "out")
    assert re.search(r"cut +no +cached", printed())


def test_source_that_is_a_survey_is_used_directly(corridor: Path, tmp_path: Path) -> None:
    survey = survey_of(corridor, tmp_path / "out", length=6.0, buffer=2.0)
    assert survey_of(survey, tmp_path / "other") == survey
    assert survey_of(Path(survey).parent, tmp_path / "other") == survey
    assert survey_of("s3://bucket/survey", tmp_path) == "s3://bucket/survey"


def test_mostly_extrapolated_trajectory_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "velodyne").mkdir()
    np.zeros((9, 4), np.float32).tofile(tmp_path / "velodyne" / "0.bin")
    light = np.random.default_rng(0).integers(0, 255, (64, 128), np.uint8)
    for k in range(8):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), light if k < 2 else np.full_like(light, 9))
    place = drive(tmp_path, '[slam]\nvideo = "frames"\n[sweeps]\nfolder = "velodyne"\n')
    with pytest.raises(LowConfidenceError, match=r"of the poses are extrapolated.*keep_unsure"):
        survey_of(place, tmp_path / "out")
    assert (tmp_path / "out" / "prepared" / "slam" / "trajectory.csv").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have either"),
        ('corridor = "a"\n[sweeps]\nfolder = "b"\nposes = "c"', "must have either"),
        ('corridor = "a"\nspeed = 3', "`speed`"),
        ("corridor = [", "TOML"),
    ],
)
def test_invalid_drive_is_an_input_error(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Drive.read(drive(tmp_path, text))


def test_second_run_of_a_drive_is_a_busy_error(corridor: Path, tmp_path: Path) -> None:
    with locked(tmp_path / "out" / PREPARED), pytest.raises(BusyError):
        survey_of(corridor, tmp_path / "out")
