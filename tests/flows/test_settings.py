"""Settings: defaults of the mission, what the user sets, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.flows.recipe import PER_CLASS, STEPS
from scan2sim.flows.settings import Settings
from scan2sim.pipeline.errors import SettingError
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM


def test_defaults_are_the_missions_numbers() -> None:
    settings = Settings.read()
    assert [settings.params(DECIMATE, g).target for g in ("terrain", "building", "vegetation")] == [
        100_000,
        100_000,
        300_000,
    ]
    assert [settings.params(TRIM, g).max_edge for g in ("terrain", "building", "vegetation")] == [0.5, 0.25, 0.25]


def test_a_class_wins_over_all_classes_and_the_command_line_over_the_file(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[decimate]\ntarget = 20000\n[decimate.building]\ntarget = 30000\n")
    settings = Settings.read(tmp_path / "s.toml", ["decimate.vegetation.target=40000", "split.vegetation=both"])
    assert [settings.params(DECIMATE, g).target for g in ("terrain", "building", "vegetation")] == [
        20_000,
        30_000,
        40_000,
    ]
    assert settings.params(SPLIT).vegetation == "both"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("decimat.target=50000", "Did you mean `decimate`"),
        ("decimate.targt=50000", "Did you mean `target`"),
        ("decimate.roof.target=50000", "no such parameter"),
        ("decimate.target", "is no assignment"),
        ("target=5", "is no assignment"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(text: str, message: str) -> None:
    with pytest.raises(SettingError) as caught:
        Settings.read(None, [text]).check(STEPS, PER_CLASS)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text", ["decimate.target=5", "decimate.target=many", "split.vegetation=maybe", "voxel.size=-1"]
)
def test_values_out_of_range_are_refused(text: str) -> None:
    settings = Settings.read(None, [text])
    step = next(s for s in STEPS if s.name == text.split(".")[0])
    with pytest.raises(SettingError, match=text.split("=")[0]):
        settings.params(step, "terrain")


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[decimate\n")
    with pytest.raises(SettingError, match="TOML"):
        Settings.read(tmp_path / "s.toml")
