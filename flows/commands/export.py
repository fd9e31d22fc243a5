"""`scan2sim export`: a finished world in other formats, without running any step again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.flows.commands.options import options
from scan2sim.pipeline.errors import SettingError
from scan2sim.pipeline.io import scenes
from scan2sim.pipeline.io.crs import LOCAL
from scan2sim.pipeline.io.importing import tile_folder
from scan2sim.pipeline.io.scene import read_scene
from scan2sim.pipeline.io.scenes import SceneParams

app = App()


@app.command()
@options(SceneParams)
def export(
    params: SceneParams,
    world: Annotated[Path, typer.Argument(metavar="WORLD", help="The folder that run or survey was given as --out.")],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT,...", help="Formats (docs/simulators.md).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for what is written.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an export that is there already.")] = False,
) -> None:
    """Write a finished world in other formats, for other simulators."""
    formats = list(dict.fromkeys(filter(None, map(str.strip, to.split(",")))))
    if not formats:
        raise SettingError("--to", "names no format", f"Choose of: {', '.join(scenes.known())}")
    scenes.check(formats, params, "--to")
    scene = read_scene(world)
    with progress("export") as report, tile_folder(out, overwrite, "world") as folder:
        scenes.write(scene, formats, folder, params, report)
    if scene.frame.crs == LOCAL:
        warn(f"{scene.name} has no CRS, so nothing says where on the earth it is")
    console.print(f"World:  {out}", highlight=False, soft_wrap=True)
