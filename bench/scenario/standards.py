"""Scenarios of tracks by the standards: errors against ASAM's schemas, and players that run them.

ASAM's schemas are those that scenariogeneration carries. The player is esmini, if `SCAN2SIM_ESMINI` names its program.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
from pathlib import Path

from scan2sim.pipeline.io.geodata import opendrive
from scan2sim.pipeline.io.scenario_formats import openscenario
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.scene_roads import roads_of
from scan2sim.pipeline.scenario.scenario import from_tracks
from scan2sim.pipeline.tracking.tracks import Track

PLAYER_VARIABLE = "SCAN2SIM_ESMINI"


def check(name: str, tracks: list[Track], scene: Scene, folder: Path) -> tuple[int, bool | None]:
    """Write the scenario of a street's tracks and its roads, and check both files.

    Returns:
        Number of schema errors; whether esmini plays the scenario to its end, None without esmini.
    """
    from xmlschema import XMLSchema

    folder.mkdir(parents=True, exist_ok=True)
    file, roads = folder / f"{name}.xosc", folder / f"{name}.xodr"
    scenario = from_tracks(name, tracks, scene.tiles[0].offset)
    has_roads = opendrive.write(roads, name, scene.frame, roads_of(scene)) > 0
    openscenario.write(file, scenario, roads.name if has_roads else None, {})
    carried = {path.name: path for path in importlib.metadata.files("scenariogeneration") or ()}
    errors = 0
    for schema, checked in (("OpenSCENARIO_1_3_1.xsd", file), ("opendrive_17_core.xsd", roads)):
        if checked.is_file():
            for error in XMLSchema(str(carried[schema].locate())).iter_errors(str(checked)):
                print(f"  {checked.name}: {error.reason}")
                errors += 1
    program = os.environ.get(PLAYER_VARIABLE)
    return errors, _plays(program, file) if program and scenario.duration else None


def _plays(program: str, file: Path) -> bool:
    """Whether esmini runs a scenario to its end."""
    command = [program, "--osc", file.name, "--headless", "--fixed_timestep", "0.1"]
    done = subprocess.run(command, cwd=file.parent, capture_output=True, text=True, timeout=300)
    if done.returncode:
        print("  esmini: " + "\n".join(done.stdout.splitlines()[-3:]))
    return done.returncode == 0
