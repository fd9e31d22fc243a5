"""Help of the command line: panels, a text for every option, and no optional package needed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from itertools import chain
from typing import Any

import pytest

from scan2sim.flows.cli import COMMANDS, PANELS, loaded, main
from scan2sim.flows.pipelines.renamed import OPTIONS
from tests.conftest import ROOT

HELP_WITHOUT_EXTRAS = """
import importlib.abc, sys
from typer.testing import CliRunner
from scan2sim.flows.cli import COMMANDS, app, loaded
from scan2sim.pipeline.core.optional_deps import EXTRA_OF

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in EXTRA_OF:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

def show(path, command):
    result = CliRunner().invoke(app, [*path, "--help"])
    if result.exit_code:
        print(*path, repr(result.exception))
    for name, subcommand in getattr(command, "commands", {}).items():
        show([*path, name], subcommand)

sys.meta_path.insert(0, Blocked())
for name in COMMANDS:
    show([name], loaded(name))
"""


def all_commands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """A command and its subcommands, by their full names."""
    yield name, command
    for subcommand, value in getattr(command, "commands", {}).items():
        yield from all_commands(f"{name} {subcommand}", value)


def test_every_command_is_in_one_panel() -> None:
    assert list(chain(*PANELS.values())) == list(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_option_has_help(name: str) -> None:
    for full_name, command in all_commands(name, loaded(name)):
        assert command.help, full_name
        for parameter in command.params:
            assert parameter.help, f"{full_name}: {parameter.name}"


@pytest.mark.parametrize(
    ("arguments", "option"), [("tile x --out y --reach=20", "--reach"), ("monitor topic /a --spool b", "--spool")]
)
def test_earlier_name_of_an_option_is_rejected_with_the_new_one(
    arguments: str, option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["scan2sim", *arguments.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert f"{option}: this option was renamed" in (printed := capsys.readouterr().err)
    assert f"Write `{OPTIONS[arguments.split()[0]][option]}`" in printed


def test_every_current_option_of_the_table_exists() -> None:
    for name, options in OPTIONS.items():
        known = {o for _, command in all_commands(name, loaded(name)) for p in command.params for o in p.opts}
        assert set(options.values()) <= known and not set(options) & known


def test_help_needs_no_optional_package() -> None:
    command = [sys.executable, "-c", HELP_WITHOUT_EXTRAS]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert printed == ""
