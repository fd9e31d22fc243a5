"""The `scan2sim` command: starts in a blink, loads the one that is asked for, and tells errors by one table."""

from __future__ import annotations

import importlib
import io
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from scan2sim import __version__
from scan2sim.pipeline.core.errors import INTERRUPTED, IncompleteError, ScanError, exit_code, from_os_error

PAGES = Path(__file__).parents[1] / "docs"
"""Where the pages are that help and errors name as docs/NAME.md: they come with a wheel, too."""
COMMANDS = {
    "run": ("run", "Make a world of a tile; what an earlier run has finished is kept."),
    "plan": ("plan", "Show what `run` would run, and why; of a drive.toml, what `survey` would run before its tiles."),
    "tile": ("tile", "Cut a long corridor into tiles that overlap: a survey."),
    "survey": ("survey", "Make the worlds of all tiles of a survey, which meet, and one of them all."),
    "export": ("export", "Write a finished world in other formats, for other simulators."),
    "view": ("view", "Open a finished world in the browser, or render a flight through it."),
    "verify": ("verify", "Read all that was made, and say what is damaged; the next run makes that anew."),
    "inspect": ("inspect", "Show one screen of facts."),
    "sample": ("sample", "Generate a synthetic street with its ground truth."),
    "import": ("imports", "Make a tile from your files."),
    "segment": ("segment", "Classes of a tile's points and photos: `segment TILE --out DIR`."),
    "monitor": ("monitor", "The event bus: topics of ROS 2 watched, and what goes through them told."),
    "toolbox": ("toolbox", "ML toolboxes: objects, movement, classes, segments of images, from files or as a service."),
    "qos": ("qos", "Quality of service of toolboxes: what is required, and what a network and a machine give."),
    "orchestrate": (
        "orchestrate",
        "Services on edge and cloud through Open Source MANO: what is to run, and where.",
    ),
    "teleop": ("teleop", "Vehicles driven from afar, by several links at once."),
    "slam": ("slam", "Where the camera of a video went: `slam VIDEO --out DIR`."),
}
"""Commands to their files in `flows.commands`, each with an `app`, and what they are for."""


class _Later(TyperCommand):
    """Stands for a command until it is asked for."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        return loaded(str(self.name)).make_context(info_name, args, parent, **extra)


class _Commands(TyperGroup):
    """All of `COMMANDS`, each loaded when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return _Later(cmd_name, help=COMMANDS[cmd_name][1]) if cmd_name in COMMANDS else None


def loaded(name: str) -> Any:
    """The command of that name, as its file declares it."""
    module = importlib.import_module(f"scan2sim.flows.commands.{COMMANDS[name][0]}")
    return typer.main.get_command(module.app)


app = typer.Typer(
    name="scan2sim",
    cls=_Commands,
    help="Street scans (lidar clouds and posed photos) to textured worlds for robot simulators.",
    no_args_is_help=True,
    epilog=f"Pages (docs/...) are in {PAGES}.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"scan2sim {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")] = False,
) -> None:
    context.obj = _through_prefect


def _through_prefect(*arguments: Any) -> None:
    """Make a survey as a flow of Prefect; arguments as the flow's.

    Raises:
        IncompleteError: side products failed; the world is finished.
    """
    from scan2sim.flows.deployed.survey import check_server, survey
    from scan2sim.flows.deployed.tile import WITH_WARNINGS

    check_server()
    state: Any = survey(*arguments, return_state=True)
    report = Path(state.result())
    if state.name == WITH_WARNINGS:
        raise IncompleteError(report.parent / "world", state.message or "")


def replace_what_cannot_be_encoded() -> None:
    """Print `?` for characters that the terminal's encoding doesn't have (Latin-1, say), rather than fail."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def main() -> None:
    """Run the command; errors become one message and an exit code (`pipeline.core.errors.EXIT_CODES`)."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # a random.py in the current folder is not our processes' own
    replace_what_cannot_be_encoded()
    try:
        app()
    except SystemExit as ended:
        if ended.code == exit_code(KeyboardInterrupt()):  # as typer turns Ctrl-C into
            typer.echo(INTERRUPTED, err=True)
        raise
    except Exception as error:
        if isinstance(error, OSError):
            error = from_os_error(error, error.filename or "a file")

        if isinstance(error, ScanError):
            level, colour = ("warning", "yellow") if isinstance(error, IncompleteError) else ("error", "red")
            typer.secho(f"{level}: {error.where}: {error.cause}", fg=colour, err=True)
            remedy = re.sub(r"(?<![\w/])docs(?=/\w+\.md)", str(PAGES), error.remedy)
            typer.echo(f"  {remedy}{'' if remedy.endswith('?') else '.'}", err=True)
        else:
            from scan2sim.flows.commands.display import log_unexpected

            typer.secho(f"error: unexpected {type(error).__name__}: {error}", fg="red", err=True)
            typer.echo(f"  The details are in {log_unexpected(error)}; please report them.", err=True)
        sys.exit(exit_code(error))


if __name__ == "__main__":
    main()
