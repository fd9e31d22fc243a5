"""README.md of a world: how to open it, where to place a robot, and what its coordinates are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene

FILE = "README.md"


def write(folder: Path, scene: Scene, formats: Sequence[str]) -> None:
    """Write the file into a world's folder; `formats` are those of the world."""
    parts = [f"# {scene.name}\n\nA world made by scan2sim from lidar and photos, as: {', '.join(formats)}.\n"]
    if "gazebo" in formats:
        parts.append(
            f"In Gazebo, in this folder:\n\n    GZ_SIM_RESOURCE_PATH=$PWD/models gz sim {scene.name}.sdf\n\n"
            f"(Fortress: `IGN_GAZEBO_RESOURCE_PATH=$PWD/models ign gazebo {scene.name}.sdf`)\n"
        )
    parts += _placing(scene, formats)
    parts.append(_coordinates(scene))
    (folder / FILE).write_text("\n".join(parts), encoding="utf-8")


def _placing(scene: Scene, formats: Sequence[str]) -> list[str]:
    """Where a robot can be placed."""
    if scene.spawn is None:
        return ["No free ground was found near the origin: choose yourself where to place a robot.\n"]
    x, y, z = scene.spawn.position
    text = (
        f"A robot can be placed at x = {x:.2f}, y = {y:.2f}, z = {z:.2f} m, heading {scene.spawn.angles[2]:.3f} rad "
        "(`spawn` in metadata.json): free ground, 2 cm below."
    )
    if "gazebo" in formats:
        text += f" While Gazebo runs:\n\n    {sdf.spawn_command(scene.spawn)}\n"
    return [text.rstrip("\n") + "\n"]


def _coordinates(scene: Scene) -> str:
    """What its coordinates are."""
    x, y, z = scene.origin
    where = "a local frame" if scene.frame.crs == "local" else scene.frame.crs
    return (
        f"Coordinates are metres, z up; x = y = z = 0 is ({x:.10g}, {y:.10g}, {z:.10g}) m in {where} "
        "(`world_origin_m` in metadata.json, which has the rest).\n"
    )
