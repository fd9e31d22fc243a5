"""Shell commands that open a world in Gazebo, for the terminal and for reports."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

RELEASES = {
    "gz sim": ("Garden and later", "GZ_SIM_RESOURCE_PATH"),
    "ign gazebo": ("Fortress", "IGN_GAZEBO_RESOURCE_PATH"),
}
"""Command to the Gazebo releases that have it, and their environment variable for model paths."""


def commands(sdf: Path) -> dict[str, str]:
    """Gazebo release to the shell command that opens a world; empty if the file doesn't exist.

    Args:
        sdf: the world file, in the folder of its `models/`.
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
    """Lines printed at the end of a run: path of the world, commands that open it in a browser and in Gazebo."""
    installed = "ign gazebo" if shutil.which("ign") else "gz sim"
    by_release = commands(sdf)
    folder = sdf.parent
    world = [f"World:  {folder}", f"View:   scan2sim view {shlex.quote(str(folder))}"] if folder.is_dir() else []
    return [*world, *([f"Gazebo: {by_release[RELEASES[installed][0]]}"] if by_release else [])]
