"""`scan2sim export`: converts a finished world to other formats, without repeating any step."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.budget import Budget, parse_budget
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.flows.commands.options import options
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata.crs import LOCAL
from scan2sim.pipeline.io.tile_folder import tile_folder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene

app = App()


@contextmanager
def _simplified(scene: Scene, limits: Budget, levels: int, folder: Path, report: Report) -> Iterator[Scene]:
    """The scene reduced to a budget, with levels of detail; its files in `folder` are deleted with the context."""
    with tempfile.TemporaryDirectory(prefix=".simplified-", dir=folder) as work:
        if limits != Budget():
            from scan2sim.texturing.simplify_textured import simplified_scene

            scene = simplified_scene(scene, limits.triangles, limits.texels, Path(work) / "within", report)
        if levels > 1:
            from scan2sim.texturing.levels_of_detail import with_levels

            scene = with_levels(scene, levels, Path(work) / "levels", report)
        yield scene


def _warn_of_exceeded_budget(scene: Scene, limits: Budget) -> None:
    """Warn of tiles that exceed the budget even after simplification."""
    for tile in scene.tiles:
        count = sum(figures["triangles"] for figures in tile.groups.values())
        if limits.triangles is not None and count > 1.05 * limits.triangles:
            warn(f"{tile.name} has {count:,} triangles, more than the budget: those at its borders can't be simplified")


@app.command()
@options(SceneParams)
def export(
    params: SceneParams,
    world: Annotated[Path, typer.Argument(metavar="WORLD", help="Output folder of `scan2sim run` or `survey`.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT,...",
            help=f"Formats to write: {', '.join(world_formats.format_names())} (docs/simulators.md).",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the converted world.")],
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            metavar="triangles=200k,texture=64MP",
            help="Limits of each tile, simplified to meet them: number of triangles, megapixels of texture.",
        ),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option(
            "--levels", help="Number of levels of detail (LOD) of each tile, 1 to 6; default: 3 for tiles3d, else 1."
        ),
    ] = None,
    robot: Annotated[
        bool,
        typer.Option("--robot", help="Add a small robot with camera and lidar, on the road (docs/robot.md)."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing export.")] = False,
) -> None:
    """Convert a finished world to other formats, for other simulators."""
    export_world(world, to, out, params, budget=budget, levels=levels, robot=robot, overwrite=overwrite)


def export_world(
    world: Path,
    to: str | Sequence[str],
    out: Path,
    params: SceneParams,
    *,
    budget: str | None = None,
    levels: int | None = None,
    robot: bool = False,
    overwrite: bool = False,
) -> Path:
    """Convert the world in a folder to formats, a list or a text with commas; returns `out`.

    Raises:
        ScanError: unknown format, a missing package, no world, or `out` is not empty.
    """
    words = to.split(",") if isinstance(to, str) else to
    formats = list(dict.fromkeys(filter(None, map(str.strip, words))))
    if not formats:
        raise SettingError("--to", "names no format", f"Choose from: {', '.join(world_formats.format_names())}")
    world_formats.check(formats, params, "--to", robot)
    limits = parse_budget(budget)
    scene = read_scene(world)
    with (
        progress("export") as report,
        tile_folder(out, overwrite, "world") as folder,
        _simplified(scene, limits, levels or world_formats.levels(formats), folder, report) as small,
    ):
        world_formats.write(small, formats, folder, params, report, robot)
        _warn_of_exceeded_budget(small, limits)
    if scene.frame.crs == LOCAL:
        warn(f"{scene.name} has no CRS: the export is not georeferenced")
    if "carla" in formats and not any((out / "carla").rglob("*.xodr")):
        warn(
            f"{scene.name} has no roads with lanes, so CARLA's map has no OpenDRIVE: waypoints, the traffic manager "
            "and pedestrians don't work there (docs/roads.md)"
        )
    console.print(f"World:  {out}", highlight=False, soft_wrap=True)
    return out
