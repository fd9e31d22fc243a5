"""`scan2sim export`: a finished world in other formats, without running any step again."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.budget import Budget, parse
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.flows.commands.options import options
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.importers.tile_folder import tile_folder
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata.crs import LOCAL
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene

app = App()


@contextmanager
def _within(scene: Scene, limits: Budget, levels: int, report: Report) -> Iterator[Scene]:
    """The scene within a budget and in levels of detail, for as long as it is written."""
    with tempfile.TemporaryDirectory() as work:
        if limits != Budget():
            from scan2sim.texturing.simplify_textured import reduced

            scene = reduced(scene, limits.triangles, limits.texels, Path(work) / "within", report)
        if levels > 1:
            from scan2sim.texturing.levels_of_detail import detailed

            scene = detailed(scene, levels, Path(work) / "levels", report)
        yield scene


def _tell(scene: Scene, limits: Budget) -> None:
    """Warn of tiles that are over the budget all the same."""
    for tile in scene.tiles:
        count = sum(figures["triangles"] for figures in tile.groups.values())
        if limits.triangles is not None and count > 1.05 * limits.triangles:
            warn(f"{tile.name} has {count:,} triangles: where its surfaces end they are kept, for tiles to meet")


@app.command()
@options(SceneParams)
def export(
    params: SceneParams,
    world: Annotated[Path, typer.Argument(metavar="WORLD", help="The folder that run or survey was given as --out.")],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT,...", help="Formats (docs/simulators.md).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for what is written.")],
    budget: Annotated[
        str | None,
        typer.Option("--budget", metavar="triangles=200k,texture=64MP", help="What each tile may have, at most."),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option("--levels", help="Levels of detail of each tile, from 1 to 6. Default: 3 for tiles3d, else 1."),
    ] = None,
    robot: Annotated[
        bool,
        typer.Option("--robot", help="Put a small robot with camera and lidar on the road (docs/robot.md)."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an export that is there already.")] = False,
) -> None:
    """Write a finished world in other formats, for other simulators."""
    formats = list(dict.fromkeys(filter(None, map(str.strip, to.split(",")))))
    if not formats:
        raise SettingError("--to", "names no format", f"Choose of: {', '.join(world_formats.known())}")
    world_formats.check(formats, params, "--to", robot)
    limits = parse(budget)
    scene = read_scene(world)
    with (
        progress("export") as report,
        tile_folder(out, overwrite, "world") as folder,
        _within(scene, limits, levels or world_formats.levels(formats), report) as small,
    ):
        world_formats.write(small, formats, folder, params, report, robot)
        _tell(small, limits)
    if scene.frame.crs == LOCAL:
        warn(f"{scene.name} has no CRS, so nothing says where on the earth it is")
    console.print(f"World:  {out}", highlight=False, soft_wrap=True)
