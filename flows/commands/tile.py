"""`scan2sim tile`: cuts a corridor (a long recording) into the overlapping tiles of a survey."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import progress
from scan2sim.flows.commands.options import options
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey

app = App()


@app.command()
@options(CutParams, copy_photos="--copy")
def tile(
    params: CutParams,
    corridor: Annotated[
        Path, typer.Argument(metavar="CORRIDOR", help="tile.toml of the long recording, or its folder.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder of the survey to create: survey.toml and the tiles.")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the survey; default: that of the recording.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing survey.")] = False,
) -> None:
    """Cut a long recording (a corridor) into a survey of overlapping tiles."""
    warnings: list[str] = []
    with progress("tile") as report:
        path = cut_survey(corridor, out, params, name=name, overwrite=overwrite, report=report, warn=warnings.append)
    for warning in warnings:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Survey: {path}")
