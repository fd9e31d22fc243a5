"""README.md of a world: how to open it, where to place a robot, what its sensors need, and what its coordinates are."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path

from scan2sim.pipeline.io.geodata.crs import LOCAL
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene

FILE = "README.md"
CAMERA_FAR_M = 1000
"""Far clipping distance for the sky dome of a tile, which has a radius of 400 m."""
OPENING = {
    "usd": "Isaac Sim, Omniverse, Blender, usdview: open `{name}.usdc`; the folder `usd` belongs beside it.",
    "mujoco": "MuJoCo: `python -c 'import mujoco.viewer as v; v.launch_from_path(\"{name}.xml\")'`",
    "urdf": "PyBullet: `python -c 'import pybullet as p; p.connect(p.GUI); "
    'p.loadURDF("{name}.urdf", useFixedBase=True); input()\'`',
    "carla": "CARLA: copy the folder `carla` into `Import` of a build from source, then `make import` there.",
    "tiles3d": "CesiumJS: load `tileset.json` from a web server.",
    "splats_tiles3d": "CesiumJS: load `splats_tileset.json` from a web server.",
    "glb": "Blender, Unity, three.js and others: the `.glb` files, which are y up, in metres.",
    "splats": "Viewers of splats: the `.ply` files, z up, or the `.spz` files, y up.",
    "openscenario": "esmini: `esmini --osc {name}.xosc --window 60 60 1024 576`",
}
"""How to open a world, by format other than Gazebo's."""


def write(folder: Path, scene: Scene, formats: Sequence[str]) -> None:
    """Write the file into a world's folder; `formats` are those of the world."""
    parts = [f"# {scene.name}\n\nA world made by scan2sim, as: {', '.join(formats)}.\n"]
    if "gazebo" in formats:
        world = f"{scene.name}.sdf"
        parts.append(
            f"In Gazebo, in this folder:\n\n    {sdf.open_command(world)}\n\n"
            f"(Fortress, from 6.16: `{sdf.open_command(world, fortress=True)}`; Gazebo Classic doesn't read it)\n"
        )
        if scene.robot_map is not None:
            parts.append(
                "With ROS 2, in this folder, Gazebo with a robot, the bridge and Nav2's map server:\n\n"
                f"    ros2 launch {scene.name}.launch.py\n"
            )
    if others := [f"- {OPENING[name].format(name=scene.name)}\n" for name in formats if name in OPENING]:
        parts.append("In other programs, in this folder:\n\n" + "".join(others))
    parts += _placing(scene, formats)
    parts += _sensors(scene, formats)
    parts.append(_coordinates(scene, formats))
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
        text += (
            f" While Gazebo runs:\n\n    {sdf.spawn_command(scene.spawn)}\n\n"
            "ROBOT.sdf may be a URDF, too; `-topic robot_description` in place of `-file ROBOT.sdf` takes the URDF "
            "that robot_state_publisher publishes.\n"
        )
    return [text.rstrip("\n") + "\n"]


def _sensors(scene: Scene, formats: Sequence[str]) -> list[str]:
    """What a robot's sensors need in a world with a backdrop, which only cameras may see."""
    if not scene.has_backdrop or not {"gazebo", "usd"} & set(formats):
        return []
    far = max(CAMERA_FAR_M, ceil(scene.far or 0))
    lines = [
        "Around the scan there are scenery and a sky for cameras, whose far clipping distance must be at least "
        f"{far} m. Lidars and depth cameras would measure them as well:\n"
    ]
    if "gazebo" in formats:
        lines.append(
            f"- Gazebo: add `<visibility_mask>{sdf.WITHOUT_BACKDROP}</visibility_mask>` to `<lidar>`, and "
            f"`<clip><far>{far}</far></clip>` to `<camera>`. Depth and RGB-D cameras ignore masks: for these, export "
            "the world with `--no-backdrop`.\n"
        )
    if "usd" in formats:
        lines.append("- USD: deactivate the prims `Backdrop` for them.\n")
    return [lines[0] + "\n" + "".join(lines[1:])]


def _coordinates(scene: Scene, formats: Sequence[str]) -> str:
    """What its coordinates are."""
    x, y, z = scene.origin
    is_local = scene.frame.crs == LOCAL
    text = (
        f"Coordinates are metres, z up; x = y = z = 0 is ({x:.10g}, {y:.10g}, {z:.10g}) m in "
        f"{'a local frame' if is_local else scene.frame.crs} (`world_origin_m` in metadata.json, which has the rest).\n"
    )
    if is_local and "gazebo" in formats:
        text += (
            "Its place on the earth isn't known: in Gazebo, NavSat sensors publish nothing, nor magnetometers from "
            "Harmonic on, unless you add `<spherical_coordinates>` to the world.\n"
        )
    return text
