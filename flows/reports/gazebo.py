"""Shell commands that open a world in Gazebo, for the terminal and for reports."""

from __future__ import annotations

import shlex
import shutil
import sys
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
    """Lines printed at the end of a run: path of the world, commands that open it in a browser, Gazebo and ROS 2."""
    ign = shutil.which("ign")
    # from Garden on, `ign` is a link to `gz`
    installed = "ign gazebo" if ign and Path(ign).resolve().name != "gz" else "gz sim"
    by_release = commands(sdf)
    folder = sdf.parent
    world = [f"World:  {folder}", f"View:   {_command()} view {shlex.quote(str(folder))}"] if folder.is_dir() else []
    launch = sdf.with_suffix(".launch.py")
    ros = [f"ROS 2:  ros2 launch {shlex.quote(str(launch))}"] if launch.is_file() else []
    return [*world, *([f"Gazebo: {by_release[RELEASES[installed][0]]}"] if by_release else []), *ros]


def _command() -> str:
    """The command of scan2sim: with its path if it is only found beside this Python (an inactive environment)."""
    beside = Path(sys.executable).with_name("scan2sim")
    return shlex.quote(str(beside)) if not shutil.which("scan2sim") and beside.is_file() else "scan2sim"
