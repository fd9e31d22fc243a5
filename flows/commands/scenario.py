"""`scan2sim scenario`: lists the recorded traffic of a finished world, and writes variations of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.tile_folder import tile_folder
from scan2sim.pipeline.io.world_formats.openscenario import write_scenarios
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene
from scan2sim.pipeline.io.worlds.scene_roads import roads_of
from scan2sim.pipeline.io.worlds.scene_traffic import scenario_of
from scan2sim.pipeline.io.worlds.spawn import bodies
from scan2sim.pipeline.scenario.motion_check import Ground, impossible_motions
from scan2sim.pipeline.scenario.scenario import Scenario
from scan2sim.pipeline.scenario.variation import Variation, vary

app = App(help="List and vary the recorded traffic of a finished world.")
SEARCH_HEIGHT_M = 1.0
"""Height above an actor's box bottom from which the ground is searched downwards."""
World = Annotated[Path, typer.Argument(metavar="WORLD", help="Output folder of `scan2sim run` or `survey`.")]


@app.command("list")
def list_(world: World) -> None:
    """List the recorded road users, and warn of impossible motions (overlaps, off the ground, jumps)."""
    scene = read_scene(world)
    scenario = _recorded(scene)
    table = Table("name", "size (m)", "time (s)", "way (m)", "km/h", "± (m)")
    for actor in scenario.everyone:
        track = actor.track
        way = float(np.linalg.norm(np.diff(track.poses[:, :2], axis=0), axis=1).sum())
        times = f"{actor.begin:.1f} to {actor.end:.1f}" if track.moving else "stands"
        size = " x ".join(f"{value:.1f}" for value in track.size)
        speed = f"{3.6 * float(np.median(track.speeds())):.0f}"
        table.add_row(actor.name, size, times, f"{way:.1f}", speed, f"{float(np.median(track.sigma[:, 0])):.2f}")
    console.print(table)
    for motion in impossible_motions(scenario, _ground(scene)):
        warn(str(motion))


@app.command("vary")
def vary_(
    world: World,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the variations.")],
    count: Annotated[int, typer.Option("--count", help="Number of variations, 1 to 10000.")] = 10,
    seed: Annotated[int, typer.Option("--seed", help="Random seed; the same seed gives the same variations.")] = 1,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing variations.")] = False,
) -> None:
    """Write variations of the recorded traffic as OpenSCENARIO files: a test suite.

    Road users are moved within their lanes, mirrored into the opposite lane,
    delayed, made faster or slower, added and removed; none collides with another
    or with the recorded ego. `variations.json` lists the changes.
    """
    scene = read_scene(world)
    scenario, roads = _recorded(scene), roads_of(scene)
    with progress("vary") as report, tile_folder(out, overwrite, "set of variations") as folder:
        found = []
        for number in range(1, count + 1):
            report((number - 1) / count, f"{number} of {count}")
            found.append(vary(scenario, roads, seed, number))
        write_scenarios([one.scenario for one in found], scene, folder)
        _write_changes(folder / "variations.json", found, seed)
    if not roads:
        warn(f"{scene.name} has no roads: nothing was moved within its lane or mirrored")
    console.print(f"Variations:  {out}", highlight=False, soft_wrap=True)


def _recorded(scene: Scene) -> Scenario:
    """The recorded scenario.

    Raises:
        DataError: nobody moved.
    """
    scenario = scenario_of(scene)
    if not scenario.moving:
        raise DataError(
            scene.name,
            "has no tracks of moving road users",
            "Tracks need a lidar's sweeps and its path: see docs/scenarios.md",
        )
    return scenario


def _ground(scene: Scene) -> Ground:
    """Heights of the world's ground."""
    ground, _ = bodies(scene)

    def heights(places: F64) -> F64:
        above = places + (0.0, 0.0, SEARCH_HEIGHT_M)
        rays = np.concatenate([above, np.tile((0.0, 0.0, -1.0), (len(above), 1))], axis=1).astype(np.float32)
        distance = ground.cast_rays(rays)["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(distance), above[:, 2] - distance, np.nan)

    return heights


def _write_changes(path: Path, variations: Sequence[Variation], seed: int) -> None:
    content = {"seed": seed, "variations": {one.scenario.name: one.changes for one in variations}}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
