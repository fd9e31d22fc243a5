"""`scan2sim sample`: generates a synthetic street recording with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scan2sim.data_samples import SMALL
from scan2sim.data_samples.street import generate
from scan2sim.flows.commands.app import App, Overwrite
from scan2sim.flows.commands.display import progress
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.tile_folder import tile_folder

app = App()


@app.command()
def sample(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the tile to create.")],
    small: Annotated[
        bool,
        typer.Option(
            "--small", help="Copy the bundled street of 26 m instead of generating one; ignores the other options."
        ),
    ] = False,
    length: Annotated[float, typer.Option(help="Length of the road in metres.")] = 100.0,
    points: Annotated[float, typer.Option(help="Number of points of the cloud.")] = 9e6,
    photos: Annotated[int, typer.Option(help="Number of photos.")] = 40,
    seed: Annotated[int, typer.Option(help="Random seed; each seed gives another street.")] = 0,
    traffic: Annotated[
        bool,
        typer.Option("--traffic", help="Add a car ahead, a cyclist and a pedestrian, with ground-truth tracks."),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Generate a synthetic street recording with ground truth, to try the program."""
    with progress("street") as report, tile_folder(out, overwrite) as folder:
        if small:
            copy_tree(SMALL, folder)
        else:
            system_libs.check()
            generate(folder, length=length, points=points, photos=photos, seed=seed, traffic=traffic, report=report)
    typer.echo(f"Tile: {out / 'tile.toml'}")
