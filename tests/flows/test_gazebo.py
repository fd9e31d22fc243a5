"""The shell commands that open a world."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scan2sim.flows.reports import gazebo


@pytest.mark.parametrize(("program", "release"), [("gz", "Garden and later"), ("ign", "Fortress")])
def test_command_passes_world_and_models_of_any_folder_name(tmp_path: Path, program: str, release: str) -> None:
    world = tmp_path / "it's a $HOME & more" / "world"
    (world / "models").mkdir(parents=True)
    (world / "street.sdf").write_text("<sdf/>", encoding="utf-8")
    fake = tmp_path / "bin" / program
    fake.parent.mkdir()
    fake.write_text('#!/bin/sh\necho "$2"\necho "$GZ_SIM_RESOURCE_PATH$IGN_GAZEBO_RESOURCE_PATH"\n', encoding="utf-8")
    fake.chmod(0o755)
    variables = {"GZ_SIM_RESOURCE_PATH": "/robots"} if program == "gz" else {"IGN_GAZEBO_RESOURCE_PATH": "/robots"}
    printed = subprocess.run(
        ["sh", "-c", gazebo.commands(world / "street.sdf")[release]],
        env={"PATH": f"{fake.parent}:{os.environ['PATH']}", **variables},
        check=True, capture_output=True, text=True,
    ).stdout.splitlines()  # fmt: skip
    assert printed == [str(world / "street.sdf"), f"{world / 'models'}:/robots"]


def test_missing_world_has_no_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: name)
    assert gazebo.commands(tmp_path / "street.sdf") == {}
    shown = f"View:   scan2sim view {shlex.quote(str(tmp_path))}"
    assert gazebo.lines(tmp_path / "street.sdf") == [f"World:  {tmp_path}", shown]


@pytest.mark.parametrize(("target", "command"), [("gz", "gz sim"), ("ign-tools", "ign gazebo")])
def test_printed_command_is_that_of_the_installed_release(
    target: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Garden and later install `ign` as a link to `gz`; Fortress has a program of its own."""
    (tmp_path / target).touch()
    (tmp_path / "ign").symlink_to(tmp_path / target)
    monkeypatch.setattr(shutil, "which", lambda name: str(tmp_path / name))
    (tmp_path / "street.sdf").write_text("<sdf/>", encoding="utf-8")
    (line,) = (line for line in gazebo.lines(tmp_path / "street.sdf") if line.startswith("Gazebo:"))
    assert f" {command} " in line


def test_command_of_an_inactive_environment_has_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    (tmp_path / "scan2sim").touch()
    view = f"View:   {shlex.quote(str(tmp_path / 'scan2sim'))} view {shlex.quote(str(tmp_path))}"
    assert gazebo.lines(tmp_path / "street.sdf")[1] == view
