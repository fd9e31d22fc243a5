"""Building blocks of the commands: validation of numeric options, and options shared by several commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from scan2sim.flows.commands import option_ranges
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core import optional_deps


class _Command(TyperCommand):
    """A command whose packages and numeric options are checked before it runs.

    Attributes:
        requirement: arguments of `optional_deps.require`: what needs the packages, and their names.
    """

    requirement: tuple[str, ...] = ()

    def invoke(self, ctx: Any) -> Any:
        if self.requirement:
            optional_deps.require(*self.requirement)
        option_ranges.check(ctx.params)
        return super().invoke(ctx)


class _DefaultCommandGroup(TyperGroup):
    """A group whose first command is the default: `segment TILE` means `segment tile TILE`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)


DEFAULT_COMMAND = "The first command is the default and may be left out; its own --help lists its options."


class App(typer.Typer):
    """A command, or a group of commands.

    Args:
        help: help of the group; None for a single command.
        first: run the group's first command where none is named.
        requirement: what needs optional packages, and their names; checked when a command runs, not for its help.
    """

    def __init__(self, help: str | None = None, *, first: bool = False, requirement: tuple[str, ...] = ()) -> None:
        self._requirement = requirement
        group = _DefaultCommandGroup if first else TyperGroup
        super().__init__(
            cls=group, help=help, epilog=DEFAULT_COMMAND if first else None, no_args_is_help=help is not None,
            add_completion=False,
        )  # fmt: skip

    def command(self, name: str | None = None, **options: Any) -> Any:
        """Decorator that declares a command, with the arguments of `Typer.command`."""
        command_class = type("_Command", (_Command,), {"requirement": self._requirement})
        return super().command(name, cls=command_class, **options)


def _named(out: Path) -> Path:
    """A folder by its name, for `.` and `..`: tiles are named after their folders."""
    return out if out.name not in ("", "..") else out.resolve()


TilePath = Annotated[
    Path,
    typer.Argument(
        metavar="TILE", help="Tile (clouds and photos, see `scan2sim import`): its folder, or its tile.toml."
    ),
]
OutDir = Annotated[Path, typer.Option("--out", "-o", help="Output folder: world, report, log and cached results.")]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STEP.PARAM=VALUE",
        help="Change a setting of a step; repeatable; docs/reference/settings.md lists all settings.",
    ),
]
Config = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="TOML file with settings; --set overrides it.")
]
HoldOut = Annotated[
    int | None,
    typer.Option(
        "--hold-out",
        metavar="N",
        help="Exclude every Nth photo from texturing, and every Nth sweep of a lidar from the cloud, to measure the "
        "quality of the world with them; default: none.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Repeat all steps, even those with cached results.")]
From = Annotated[
    str | None,
    typer.Option("--from", metavar="STEP", help="Repeat this step, and all that depend on it; reuse the others."),
]
Bus = Annotated[
    str | None,
    typer.Option(
        "--bus",
        metavar="HOST:PORT,...",
        help="Publish progress: to Kafka at these addresses, to ROS 2 (`ros2`), or both, comma-separated.",
    ),
]
Name = Annotated[
    str | None,
    typer.Option("--name", help="Name of the tile: letters, digits, underscores; default: from the folder's name."),
]
TileOut = Annotated[Path, typer.Option("--out", "-o", callback=_named, help="Folder of the tile to create.")]
Crs = Annotated[
    str | None,
    typer.Option(
        help='CRS of the coordinates: "EPSG:32633", or "local" for none; wins over the files\' own, the default.'
    ),
]
Classes = Annotated[
    str,
    typer.Option(
        metavar="CODE=CLASS,...",
        help="Meaning of the cloud's class codes, such as 65=noise,200=5, or the name of a data set: SemanticKITTI "
        "(docs/reference/formats.md#classes).",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Link = Annotated[bool, typer.Option("--link", help="Link the input files into the tile instead of copying them.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing tile.")]


def settings_of(set_: list[str] | None, config: Path | None, hold_out: int | None = None) -> Settings:
    """Settings from the options --set, --config and --hold-out of a command.

    Raises:
        SettingError: the file can't be read, or an assignment has a wrong form.
    """
    held_out = [] if hold_out is None else [f"{step}.hold_out={hold_out}" for step in ("views", "sweeps")]
    return Settings.read(config, [*(set_ or []), *held_out])
