"""What commands are made of: numbers looked at before they begin, and the options that several have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from scan2sim.flows.commands import option_ranges
from scan2sim.flows.pipelines.settings import Settings


class _Command(TyperCommand):
    """A command whose numbers are looked at before it begins."""

    def invoke(self, ctx: Any) -> Any:
        option_ranges.check(ctx.params)
        return super().invoke(ctx)


class _FirstIsDefault(TyperGroup):
    """`segment TILE` is `segment tile TILE`, `slam VIDEO` is `slam video VIDEO`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)


class App(typer.Typer):
    """A command, or a group of them, as they are declared.

    Args:
        first: the group's first command is meant where none is named.
    """

    def __init__(self, help: str | None = None, *, first: bool = False) -> None:
        group = _FirstIsDefault if first else TyperGroup
        super().__init__(cls=group, help=help, no_args_is_help=help is not None, add_completion=False)

    def command(self, name: str | None = None, **options: Any) -> Any:
        """As Typer's."""
        return super().command(name, cls=_Command, **options)


TilePath = Annotated[Path, typer.Argument(metavar="TILE", help="A tile.toml, or the folder that holds one.")]
OutDir = Annotated[Path, typer.Option("--out", "-o", help="Folder for the world, the report and kept results.")]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="STEP.PARAM=VALUE", help="Change a setting.")]
Config = Annotated[Path | None, typer.Option("--config", help="Settings as a TOML file.")]
HoldOut = Annotated[
    int | None, typer.Option("--hold-out", metavar="N", help="Keep every Nth photo out of texturing, to score it.")
]
Force = Annotated[bool, typer.Option("--force", help="Run everything again.")]
From = Annotated[str | None, typer.Option("--from", metavar="STEP", help="Run this step and what follows again.")]
Bus = Annotated[
    str | None,
    typer.Option("--bus", metavar="HOST:PORT,...", help="Tell the event bus of it: Kafka there, `ros2`, or both."),
]
Name = Annotated[str | None, typer.Option("--name", help="The tile's name; default: from the folder.")]
TileOut = Annotated[Path, typer.Option("--out", "-o", help="The tile's folder.")]
Crs = Annotated[str | None, typer.Option(help='CRS, where the files lack it: "EPSG:32633", or "local".')]
Classes = Annotated[
    str, typer.Option(metavar="CODE=CLASS,...", help="What codes of the cloud are: 65=noise,200=5 (docs/formats.md).")
]
Link = Annotated[bool, typer.Option("--link", help="Link files into the tile instead of copying them.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a tile that is there already.")]


def settings_of(set_: list[str] | None, config: Path | None, hold_out: int | None = None) -> Settings:
    """Settings as the options of a command say.

    Raises:
        SettingError: a file can't be read, or an assignment isn't one.
    """
    held_out = [] if hold_out is None else [f"views.hold_out={hold_out}"]
    return Settings.read(config, [*(set_ or []), *held_out])
