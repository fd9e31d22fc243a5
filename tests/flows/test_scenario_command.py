"""`scan2sim scenario`: the recorded traffic of a world, and variations of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from scan2sim.pipeline.io.worlds.scene import TRACKS_FILE
from scan2sim.pipeline.tracking.tracks import write_tracks
from tests.fakes import synthetic, traffic


@pytest.fixture
def world(tmp_path: Path) -> Path:
    scene = synthetic.scene(tmp_path, tiles=1)
    write_tracks(scene.tiles[0].folder / TRACKS_FILE, traffic.tracks(), scene.tiles[0].frame)
    return tmp_path / "world"


def run(*words: object) -> int:
    """Run the program; returns its exit code."""
    return subprocess.run([sys.executable, "-m", "scan2sim.flows.cli", "scenario", *map(str, words)]).returncode


def test_list_shows_everyone_and_what_is_impossible(world: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("list", world) == 0
    text = "".join(capfd.readouterr())
    assert "4.3 x 1.8 x 1.6" in text and "van_2" in text and "90" in text and "stands" in text
    assert "off the ground" in text  # the road of the tracks is 10 m above the ground of this world


def test_vary_writes_scenarios_and_never_overwrites(
    world: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "suite"
    assert run("vary", world, "--out", out, "--count", 3, "--seed", 5) == 0
    names = [f"town_{number:03d}" for number in (1, 2, 3)]
    assert sorted(path.stem for path in out.glob("*.xosc")) == names
    changes = json.loads((out / "variations.json").read_text(encoding="utf-8"))
    assert changes["seed"] == 5 and list(changes["variations"]) == names
    assert "no roads" in "".join(capfd.readouterr())
    before = (out / "town_001.xosc").read_bytes()
    assert run("vary", world, "--out", out) != 0
    assert "--overwrite" in "".join(capfd.readouterr())
    assert run("vary", world, "--out", out, "--count", 3, "--seed", 5, "--overwrite") == 0
    assert (out / "town_001.xosc").read_bytes() == before
    assert run("vary", world, "--out", tmp_path / "none", "--count", 0) != 0


def test_world_without_traffic_is_explained(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    synthetic.scene(tmp_path, tiles=1)
    assert run("vary", tmp_path / "world", "--out", tmp_path / "suite") != 0
    text = "".join(capfd.readouterr())
    assert "no tracks of moving road users" in text and "docs/scenarios.md" in text and "Traceback" not in text
    assert not (tmp_path / "suite").exists()
