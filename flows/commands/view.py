"""`scan2sim view`: shows a finished world in the browser, or renders a flight through it as a video."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.browser import open_page
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.commands.options import options
from scan2sim.flows.reports import film as films
from scan2sim.flows.reports.comparison_film import comparison_film
from scan2sim.flows.reports.view import INDEX, Pages, ViewParams, server
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.tile_folder import tile_folder
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene

app = App()


@app.command()
@options(ViewParams)
def view(
    params: ViewParams,
    world: Annotated[Path, typer.Argument(metavar="WORLD", help="Output folder of `scan2sim run` or `survey`.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Write the page to this folder, to open it without a server; default: serve it."
        ),
    ] = None,
    film: Annotated[
        Path | None,
        typer.Option("--film", metavar="FLIGHT.mp4", help="Render a flight through the world to this video."),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="TILE",
            help="With --film: instead of a flight, render the world with its recorded traffic at the poses and times "
            "of the photos of this tile, beside the photos.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing page.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Serve the page without opening a browser.")] = False,
) -> None:
    """Open a finished world in the browser, or render a flight through it as a video."""
    if film is not None:
        require("--film", "av")
    elif compare is not None:
        raise SettingError("--compare", "needs a video to write", "Add --film FILM.mp4")
    scene = read_scene(world)
    if film is not None and compare is not None:
        photos = {view.name: view.photo for view in read_tile(compare).views}
        with progress("film") as report:
            comparison_film(scene, photos, film, params.width, report)
        console.print(f"Film: {film}", highlight=False, soft_wrap=True)
    elif film is not None:
        with progress("flight") as report:
            films.film(scene, film, params.seconds, params.width, report)
        console.print(f"Flight: {film}", highlight=False, soft_wrap=True)
    elif out is not None:
        with progress("page") as report, tile_folder(out, overwrite, "page") as folder:
            pages = Pages(scene, folder, params.megapixels)
            for i, script in enumerate(pages.scripts):
                report(i / len(pages.scripts), script)
                pages.write(script)
        console.print(f"Page: {out / INDEX}", highlight=False, soft_wrap=True)
    else:
        _serve(scene, params, browser=not quiet)


def _serve(scene: Scene, params: ViewParams, *, browser: bool) -> None:
    """Serve a world's page until Ctrl-C."""
    with tempfile.TemporaryDirectory() as folder:
        pages = Pages(scene, Path(folder), params.megapixels)
        with server(pages, params.port) as served:
            address = f"http://localhost:{served.server_port}/"
            console.print(f"World:  {address}  (Ctrl-C stops the server)", highlight=False, soft_wrap=True)
            if browser:
                open_page(address)
            with suppress(KeyboardInterrupt):
                served.serve_forever()
