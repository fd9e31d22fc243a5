"""Worlds as their consumers load them: MuJoCo's pages, z = 0 and spawn pose, sides of walls; walls between voxels."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, scan
from scan2sim.pipeline.core.types import F64

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
OFFSETS_M = (0.0, 0.01, 0.03, 0.05, 0.08)
"""Distances of a flat wall from the face between two layers of voxels of 10 cm."""
WALL_M, WALL_NOISE_M, WALL_POINTS_PER_M2 = (12.0, 3.0), 0.004, 1000
LEAST_AREA, MARGIN_M, OTHER_SIDE = 0.95, 0.2, 0.02
"""Least share of a wall that has a surface; metres by which it may extend beyond; largest share that faces the other
side."""


def cases() -> Iterator[Case]:
    """Cases of kinds 7 and 8."""
    for axis in (0, 1):
        for offset in OFFSETS_M:
            yield Case(f"wall-{'xy'[axis]}-{100 * offset:.0f}-cm", 8, _wall(axis, offset), check=_is_one_surface(axis))
    for size in (128, 256, 512, 1024):
        yield Case(f"world-pages-{size}", 7, _world(f"unwrap.page_size={size}"), check=_mujoco_loads)
    yield Case("world-spawn", 7, _world(), check=_is_on_the_ground)
    yield Case("world-sides", 7, _world(), check=_has_both_sides)


def _world(*settings: str) -> Callable[[Path], Sequence[object]]:
    def make(folder: Path) -> Sequence[object]:
        made = scan(COUNT)
        rows = np.column_stack([made.xyz - PLACE + (0, 0, 52.75), made.rgb, made.code])
        return _run(folder, rows, (*SETTINGS, *settings))

    return make


def _run(folder: Path, rows: F64, settings: Sequence[str]) -> Sequence[object]:
    """Write a tile with rows x, y, z, r, g, b, class; arguments of the command that builds its world."""
    tile = folder / "tile"
    tile.mkdir()
    form, header = ["%.3f"] * 3 + ["%d"] * 4, "x,y,z,r,g,b,class"
    np.savetxt(tile / "cloud.csv", rows, form, delimiter=",", header=header, comments="")
    (tile / "tile.toml").write_text('name = "yard"\ncrs = "local"\nclouds = ["cloud.csv"]\n', encoding="utf-8")
    options = [word for one in settings for word in ("--set", one)]
    return ("run", tile, "--out", folder / "out", *options)


def _wall(axis: int, offset: float) -> Callable[[Path], Sequence[object]]:
    """A wall across an axis, in the middle of a yard, `offset` metres from a face between voxels."""

    def make(folder: Path) -> Sequence[object]:
        random, (length, height) = np.random.default_rng(axis), WALL_M
        ground = random.uniform(-length / 2, length / 2, (round(length * length * WALL_POINTS_PER_M2 / 2), 2))
        count = round(length * height * WALL_POINTS_PER_M2)
        wall = np.empty((count, 3))
        wall[:, axis] = random.normal(offset, WALL_NOISE_M, count)
        wall[:, 1 - axis] = random.uniform(-length / 2, length / 2, count)
        wall[:, 2] = random.uniform(0, height, count)
        xyz = np.concatenate([np.column_stack([ground, random.normal(0, WALL_NOISE_M, len(ground))]), wall])
        code = np.repeat([2, 6], [len(ground), count])
        rows = np.column_stack([xyz, np.full((len(xyz), 3), 128), code])
        return _run(folder, rows, ("export.formats=[gazebo]", "export.double_sided=false", *SETTINGS[2:]))

    return make


def _is_one_surface(axis: int) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        import trimesh

        meshes = (folder / "out" / "world" / "models" / "yard" / "meshes").glob("building*.obj")
        sides = np.zeros(2)
        for mesh in (trimesh.load_mesh(path, process=False) for path in meshes):
            along = mesh.face_normals[:, axis]
            sides += [mesh.area_faces[along < -FACING].sum(), mesh.area_faces[along > FACING].sum()]
        area, most = (float(np.prod(np.add(WALL_M, 2 * margin))) for margin in (0, MARGIN_M))
        right = LEAST_AREA * area < sides.max() < most and sides.min() < OTHER_SIDE * area
        return "" if right else f"{sides[0]:.1f} and {sides[1]:.1f} m2 face the two sides of a wall of {area:.0f} m2"

    return check


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
