"""Help of the command line: panels, a text for every option, and no optional package needed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from itertools import chain
from typing import Any

import pytest

from scan2sim.flows.cli import COMMANDS, PANELS, loaded
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


def test_help_needs_no_optional_package() -> None:
    command = [sys.executable, "-c", HELP_WITHOUT_EXTRAS]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert printed == ""
