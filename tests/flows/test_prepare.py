"""What comes before the tiles: drives, corridors, and what is redone of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from scan2sim.flows.commands.drive import read_drive, survey_of
from scan2sim.flows.recipes.video import Video
from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io.survey import read_survey


@pytest.fixture
def corridor(small_street: Path, tmp_path: Path) -> Path:
    shutil.copytree(small_street, tmp_path / "corridor")
    return tmp_path / "corridor"


def drive(folder: Path, text: str) -> Path:
    path = folder / "drive.toml"
    path.write_text(text)
    return path


def test_a_corridor_is_cut_once_and_again_when_it_changes(corridor: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    survey = Path(survey_of(corridor, out, length=6.0, buffer=2.0))
    assert len(read_survey(survey).tiles) == 2
    before = survey.stat().st_ino
    survey_of(corridor, out, length=6.0, buffer=2.0)
    assert survey.stat().st_ino == before
    survey_of(corridor, out, length=4.0, buffer=1.0)
    assert len(read_survey(survey).tiles) > 2
    before = survey.stat().st_ino
    text = (corridor / "tile.toml").read_text()
    (corridor / "tile.toml").write_text(text.replace('name = "street"', 'name = "road"'))
    survey_of(corridor, out, length=4.0, buffer=1.0)
    assert survey.stat().st_ino != before and read_survey(survey).name == "road"


def test_a_drive_says_how_it_is_cut_unless_it_is_said_otherwise(corridor: Path, tmp_path: Path) -> None:
    drive(tmp_path, 'corridor = "corridor"\n[tiles]\nlength = 6.0\nbuffer = 1.0\n')
    assert len(read_survey(Path(survey_of(tmp_path, tmp_path / "out"))).tiles) == 2
    assert len(read_survey(Path(survey_of(tmp_path, tmp_path / "out", length=4.0))).tiles) > 2


def test_newer_code_cuts_again(corridor: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = Path(survey_of(corridor, tmp_path / "out", length=6.0, buffer=2.0))
    before = survey.stat().st_ino
    monkeypatch.setattr("scan2sim.flows.commands.cut.VERSION", 1000)
    survey_of(corridor, tmp_path / "out", length=6.0, buffer=2.0)
    assert survey.stat().st_ino != before


def test_a_path_and_a_corridor_are_made_again_by_newer_code_and_of_other_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    for name in ("video.mp4", "camera.toml", "velodyne/0.bin", "image/0.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    text = '[slam]\nvideo = "video.mp4"\n[sweeps]\nfolder = "velodyne"\nphotos = "image"\ncamera = "camera.toml"\n'
    place = drive(tmp_path, text)

    def slam(video: Video, out: Path, *_: object) -> None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "trajectory.csv").write_text(video.video.read_text())

    def sweeps(folder: Path, poses: Path, out: Path, **_: object) -> None:
        made.append("sweeps")
        out.mkdir(exist_ok=True)

    monkeypatch.setattr("scan2sim.flows.commands.drive.slam_video", slam)
    monkeypatch.setattr("scan2sim.pipeline.io.sweeps.import_sweeps", sweeps)
    monkeypatch.setattr("scan2sim.pipeline.io.sweeps.camera_of_photos", lambda *_, **__: None)
    monkeypatch.setattr("scan2sim.flows.commands.drive._cut", lambda corridor, *_: corridor)

    def again() -> list[str]:
        made.clear()
        survey_of(place, tmp_path / "out")
        return list(made)

    assert again() == ["sweeps"] and again() == []
    monkeypatch.setattr("scan2sim.pipeline.io.sweeps.VERSION", 1000)
    assert again() == ["sweeps"] and again() == []
    (tmp_path / "camera.toml").write_text("another")
    assert again() == ["sweeps"]
    (tmp_path / "video.mp4").write_text("another")
    assert again() == ["sweeps"], "another video, another path"


def test_a_survey_is_itself(corridor: Path, tmp_path: Path) -> None:
    survey = survey_of(corridor, tmp_path / "out", length=6.0, buffer=2.0)
    assert survey_of(survey, tmp_path / "other") == survey
    assert survey_of(Path(survey).parent, tmp_path / "other") == survey
    assert survey_of("s3://bucket/survey", tmp_path) == "s3://bucket/survey"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "neither or both"),
        ('corridor = "a"\n[sweeps]\nfolder = "b"\nposes = "c"', "neither or both"),
        ('[sweeps]\nfolder = "b"', "nothing that places them"),
        ('corridor = "a"\nspeed = 3', "`speed`"),
        ("corridor = [", "TOML"),
    ],
)
def test_what_no_drive_says_is_told(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_drive(drive(tmp_path, text))


def test_two_at_once_are_told(corridor: Path, tmp_path: Path) -> None:
    from scan2sim.flows.commands.drive import PREPARED
    from scan2sim.flows.engine.lock import locked
    from scan2sim.pipeline.errors import BusyError

    with locked(tmp_path / "out" / PREPARED), pytest.raises(BusyError):
        survey_of(corridor, tmp_path / "out")
