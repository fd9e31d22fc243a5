"""How a world is opened in Gazebo: commands to be copied into a shell, on the screen and in reports."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

RELEASES = {
    "gz sim": ("Garden and later", "GZ_SIM_RESOURCE_PATH"),
    "ign gazebo": ("Fortress", "IGN_GAZEBO_RESOURCE_PATH"),
}
"""Command to the releases that it is of, and the variable by which it finds models."""


def commands(sdf: Path) -> dict[str, str]:
    """Releases of Gazebo to the line of shell that opens a world; empty where there is no such file.

    Args:
        sdf: the world, beside its `models/`.
    """
    if not sdf.is_file():
        return {}
    path = sdf.resolve()
    models = shlex.quote(str(path.parent / "models"))
    return {
        release: f"{variable}={models}:${variable} {command} {shlex.quote(str(path))}"
        for command, (release, variable) in RELEASES.items()
    }


def lines(sdf: Path) -> list[str]:
    """What is said at the end of a run: where the world is, and what shows it, a browser or this machine's Gazebo."""
    here = "ign gazebo" if shutil.which("ign") else "gz sim"
    found = commands(sdf)
    place = sdf.parent
    world = [f"World:  {place}", f"View:   scan2sim view {shlex.quote(str(place))}"] if place.is_dir() else []
    return [*world, *([f"Gazebo: {found[RELEASES[here][0]]}"] if found else [])]
