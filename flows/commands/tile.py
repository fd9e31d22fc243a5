"""`scan2sim tile`: a corridor cut into the overlapping tiles of a survey."""

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
    corridor: Annotated[Path, typer.Argument(metavar="CORRIDOR", help="A tile.toml too long for one tile.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The survey's folder.")],
    name: Annotated[str | None, typer.Option(help="The survey's name; default: the corridor's.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a survey that is there already.")] = False,
) -> None:
    """Cut a long corridor into tiles that overlap: a survey."""
    warnings: list[str] = []
    with progress("tile") as report:
        path = cut_survey(corridor, out, params, name=name, overwrite=overwrite, report=report, warn=warnings.append)
    for warning in warnings:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Survey: {path}")
