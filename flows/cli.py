"""The `scan2sim` command: imports a subcommand only when it is used, and maps errors to messages and exit codes."""

from __future__ import annotations

import importlib
import os
import re
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from scan2sim import __version__
from scan2sim.flows.commands import process, unchanged
from scan2sim.pipeline.core.errors import (
    INTERRUPTED,
    IncompleteError,
    ScanError,
    exit_code,
    from_name_error,
    from_os_error,
    is_about_a_file_name,
)

PAGES = Path(__file__).parents[1] / "docs"
"""Folder of the pages that help and errors name as docs/NAME.md; part of the wheel."""
KEEPING_STEPS = ("run", "export", "import", "segment", "slam", "survey")
"""Commands whose finished steps are kept when they are interrupted."""
COMMANDS = {
    "run": (
        "run",
        "Build the world of a tile, or of a robot's map; steps that an earlier run has finished are not repeated.",
    ),
    "plan": (
        "plan",
        "List the steps that `run` or `survey` with the same options would execute, why, and about how long they take.",
    ),
    "export": ("export", "Convert a finished world to other formats, for other simulators."),
    "view": ("view", "Open a finished world in the browser, or render a flight through it as a video."),
    "verify": ("verify", "Check all results against their checksums; the next run rebuilds the damaged ones."),
    "inspect": (
        "inspect",
        "Show a summary of a point cloud, a folder of clouds, a tile, a mesh, a world, a trajectory or a ROS bag.",
    ),
    "scenario": ("scenario", "List and vary the recorded traffic of a finished world."),
    "import": ("imports", "Import recordings: create a tile from point clouds, photos, sweeps, ROS bags or data sets."),
    "sample": ("sample", "Generate a synthetic street recording with ground truth, to try the program."),
    "segment": ("segment", "Classify the points and photos of a tile: `segment TILE --out DIR`."),
    "slam": ("slam", "Estimate the trajectory of a video's camera (visual SLAM): `slam VIDEO --out DIR`."),
    "tile": ("tile", "Cut a long recording (a corridor) into a survey of overlapping tiles."),
    "survey": (
        "survey",
        "Build the worlds of all tiles of a survey, with matching borders, and one world of them all.",
    ),
    "camera": (
        "camera",
        "Simulate a robot's camera in a finished world: a ROS 2 node that publishes images, depth, classes, instances.",
    ),
    "monitor": ("monitor", "Monitor ROS 2 topics and publish their statistics; alarms, archive, autoscaling."),
    "toolbox": ("toolbox", "Run ML toolboxes on images: detection, movement, classification, segmentation."),
    "qos": ("qos", "Quality of service: requirements, measurement, choice of the image encoding."),
    "orchestrate": ("orchestrate", "Deploy services on edge and cloud through Open Source MANO (OSM)."),
    "teleop": ("teleop", "Drive vehicles remotely, over several network links at once."),
}
"""Command name: its module in `flows.commands`, which has an `app`, and its help; in the order of `PANELS`."""
PANELS = {
    "Worlds": ("run", "plan", "export", "view", "verify", "inspect", "scenario"),
    "Recordings": ("import", "sample", "segment", "slam"),
    "Surveys": ("tile", "survey"),
    "Services": ("camera", "monitor", "toolbox", "qos", "orchestrate", "teleop"),
}
"""Panels of `scan2sim --help` and the commands in them."""


class _LazyCommand(TyperCommand):
    """Placeholder of a command, whose module is imported when the command runs."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        return loaded(str(self.name)).make_context(info_name, args, parent, **extra)


class _LazyGroup(TyperGroup):
    """All of `COMMANDS`, each imported when it runs."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        panel = next(name for name, commands in PANELS.items() if cmd_name in commands)
        return _LazyCommand(cmd_name, help=COMMANDS[cmd_name][1], rich_help_panel=panel)


def loaded(name: str) -> Any:
    """The command of that name, imported from its module."""
    module = importlib.import_module(f"scan2sim.flows.commands.{COMMANDS[name][0]}")
    return typer.main.get_command(module.app)


app = typer.Typer(
    name="scan2sim",
    cls=_LazyGroup,
    help="Convert street scans (lidar point clouds and posed photos) to textured worlds for robot simulators.",
    no_args_is_help=True,
    epilog=f"The documentation pages that help texts name as docs/... are in {PAGES}.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"scan2sim {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    context.obj = _run_survey_with_prefect


def _run_survey_with_prefect(*arguments: Any) -> None:
    """Build a survey as a Prefect flow, with the flow's arguments.

    Raises:
        IncompleteError: the world is finished, but side products failed.
    """
    from scan2sim.flows.deployed.prefect_server import prefect_server
    from scan2sim.flows.deployed.survey import survey
    from scan2sim.flows.deployed.tile import WITH_WARNINGS

    with prefect_server():
        state: Any = survey(*arguments, return_state=True)
        report = Path(state.result())
    if state.name == WITH_WARNINGS:
        raise IncompleteError(report.parent / "world", state.message or "")


def _keeps_steps(arguments: list[str]) -> bool:
    """Whether an interrupted command has results that the same command continues from."""
    return next(iter(arguments), "") in KEEPING_STEPS


def main() -> None:
    """Run the command; each error becomes a message and an exit code (`pipeline.core.errors.EXIT_CODES`)."""
    os.environ.setdefault(
        "PYTHONSAFEPATH", "1"
    )  # or a random.py in the current folder would shadow the standard library in subprocesses
    process.open_standard_streams()
    process.replace_unencodable_characters()
    process.raise_file_limit()
    unchanged.arguments = sys.argv[1:]
    try:
        process.check_current_folder()
        began = time.perf_counter()
        lines = unchanged.unchanged(sys.argv[1:])
        if lines is None:
            app()
        else:
            typer.echo("\n".join([*lines[:-1], f"{lines[-1]} ({time.perf_counter() - began:.1f} s)"]))
    except SystemExit as ended:
        if ended.code == exit_code(KeyboardInterrupt()):  # typer's exit code for Ctrl-C
            typer.echo(INTERRUPTED if _keeps_steps(sys.argv[1:]) else "Interrupted.", err=True)
        raise
    except Exception as error:
        if isinstance(error, OSError):
            error = from_os_error(error, error.filename or "a file")
        elif isinstance(error, UnicodeEncodeError) and is_about_a_file_name(error):
            error = from_name_error(error)

        if isinstance(error, ScanError):
            level, colour = ("warning", "yellow") if isinstance(error, IncompleteError) else ("error", "red")
            typer.secho(f"{level}: {error.where}: {error.cause}", fg=colour, err=True)
            remedy = re.sub(r"(?<![\w/])docs(?=/[\w/-]+\.md)", str(PAGES), error.remedy)
            typer.echo(f"  {remedy}{'' if remedy.endswith('?') else '.'}", err=True)
        else:
            from scan2sim.flows.commands.display import log_unexpected

            typer.secho(f"error: unexpected {type(error).__name__}: {error}", fg="red", err=True)
            typer.echo(f"  The details are in {log_unexpected(error)}; please report them.", err=True)
        sys.exit(exit_code(error))
    finally:
        unchanged.arguments = None


if __name__ == "__main__":
    main()
