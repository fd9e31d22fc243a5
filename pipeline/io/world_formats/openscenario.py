"""OpenSCENARIO: the recorded traffic as `<name>.xosc`, with its road network and the shapes of its road users.

Layout: `<name>.xosc`, `<name>.xodr` if roads with lanes were detected, `actors/<actor>.glb`.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.scenario_formats import actor_meshes
from scan2sim.pipeline.io.scenario_formats import openscenario as xosc
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.world_formats.opendrive import write_roads
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.scene_traffic import scenario_of
from scan2sim.pipeline.scenario.scenario import Scenario

ACTORS_FOLDER = "actors"


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the scenario, its network and its shapes, none of which are meshes of the world.

    Raises:
        DataError: no road users were tracked.
    """
    scenario = scenario_of(scene)
    if not scenario.duration:
        raise DataError(
            "openscenario", f"{scene.name} has no tracks of moving road users",
            "Tracks need a lidar's sweeps and its path: see docs/scenarios.md",
        )  # fmt: skip
    write_scenarios([scenario], scene, folder)
    return {}


def write_scenarios(scenarios: list[Scenario], scene: Scene, folder: Path) -> None:
    """Write scenarios in a scene's world that share its roads, and the shapes of all their actors.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    roads = f"{scene.name}.xodr" if write_roads(scene, folder) else None
    make_folder(folder / ACTORS_FOLDER)
    written: dict[tuple[object, ...], str] = {}
    for scenario in scenarios:
        models = {}
        for actor in scenario.everyone:
            shape = (actor.track.category, actor.track.size, actor.track.colour)
            if shape not in written:
                written[shape] = f"{ACTORS_FOLDER}/{actor.name}.glb"
                actor_meshes.write_glb(folder / written[shape], actor)
            models[actor.name] = written[shape]
        xosc.write(folder / f"{scenario.name}.xosc", scenario, roads, models)
