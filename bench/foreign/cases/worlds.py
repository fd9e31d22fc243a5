"""Worlds as their consumers load them: MuJoCo at every page size, z = 0 and spawn pose, both sides of walls."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, scan

COUNT = 100_000
SETTINGS = (
    "export.formats=[gazebo,mujoco,glb]", "voxel.size=0.2", "geometry.samples=1000",
    "pictures.compared=0", "pictures.width=160", "preview.triangles=0",
)  # fmt: skip
"""Settings of a small world, built quickly."""
GROUND_M = 0.05
"""Largest height of the ground above or below 0, and of the spawn pose above it."""
FACING = 0.95
"""Least component along an axis of the normal of a face that faces it."""
MIN_BACKS = 0.9
"""Least area of a wall's back, relative to its front."""


def cases() -> Iterator[Case]:
    """Cases of kind 7."""
    for size in (128, 256, 512, 1024):
        yield Case(f"world-pages-{size}", 7, _world(f"unwrap.page_size={size}"), check=_mujoco_loads)
    yield Case("world-spawn", 7, _world(), check=_is_on_the_ground)
    yield Case("world-sides", 7, _world(), check=_has_both_sides)


def _world(*settings: str) -> Callable[[Path], Sequence[object]]:
    def make(folder: Path) -> Sequence[object]:
        made, tile = scan(COUNT), folder / "tile"
        tile.mkdir()
        rows = np.column_stack([made.xyz - PLACE + (0, 0, 52.75), made.rgb, made.code])
        header = "x,y,z,r,g,b,class"
        form = ["%.3f"] * 3 + ["%d"] * 4
        np.savetxt(tile / "cloud.csv", rows, form, delimiter=",", header=header, comments="")
        (tile / "tile.toml").write_text('name = "yard"\ncrs = "local"\nclouds = ["cloud.csv"]\n', encoding="utf-8")
        options = [word for one in (*SETTINGS, *settings) for word in ("--set", one)]
        return ("run", tile, "--out", folder / "out", *options)

    return make


def _mujoco_loads(folder: Path) -> str:
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(folder / "out" / "world" / "yard.xml"))
    except ValueError as error:
        return f"MuJoCo: {error}"
    return "" if model.nmesh else "no mesh"


def _is_on_the_ground(folder: Path) -> str:
    world = folder / "out" / "world"
    about = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    if abs(about["world_origin_m"][2] - 52.75) > GROUND_M:
        return f"the ground is at {52.75 - about['world_origin_m'][2]:.2f} m"
    if abs(about["spawn"]["position_m"][2]) > GROUND_M:
        return f"the spawn pose is {about['spawn']['position_m'][2]:.2f} m high"
    texts = [(world / name).read_text(encoding="utf-8") for name in ("yard.sdf", "README.md")]
    return "" if '<frame name="spawn_pose">' in texts[0] and "placed at x" in texts[1] else "no pose in SDF or README"


def _has_both_sides(folder: Path) -> str:
    """The wall at x = 10 m, scanned from smaller x, in Gazebo's meshes, of which back faces aren't drawn."""
    import trimesh

    fronts = backs = 0.0
    for path in (folder / "out" / "world" / "models" / "yard" / "meshes").glob("*.obj"):
        if not path.name.startswith("collision_"):
            mesh = trimesh.load_mesh(path, process=False)
            fronts += mesh.area_faces[mesh.face_normals[:, 0] < -FACING].sum()
            backs += mesh.area_faces[mesh.face_normals[:, 0] > FACING].sum()
    return "" if backs > MIN_BACKS * fronts > 0 else f"{backs:.1f} m2 of backs for {fronts:.1f} m2"
