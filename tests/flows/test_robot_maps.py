"""`scan2sim run MAP`: robots' maps in any state end in a world, or in an error that says what is missing."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.building import Style, Surface, build
from scan2sim.data_samples.robot_map import Lidar, Mapping, RobotMap, record
from scan2sim.pipeline.core.types import F32, F64, U8, Frame, PointCloud
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.worlds.scene import read_scene
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import scan2sim as run_scan2sim

FAST = ("--set", "pictures.width=160", "--set", "unwrap.texel=0.2")
DATA_ERROR = 4


def scan2sim(*arguments: object) -> tuple[int, str]:
    """Run the command and its steps in this process; returns its exit code and output."""
    with inline_steps():
        return run_scan2sim(*arguments)


def room(points: int = 12_000, seed: int = 0) -> F32:
    """Walls, floor, ceiling and a table of a room of 6 x 5 x 2.6 m, around a sensor at the origin, 0.5 m high."""
    rng = np.random.default_rng(seed)

    def sheet(low: tuple[float, ...], high: tuple[float, ...], share: float) -> F64:
        return rng.uniform(low, high, (int(share * points), 3))

    parts = [
        sheet((-3, -2, 0), (3, 3, 0), 0.3),
        sheet((-3, -2, 2.6), (3, 3, 2.6), 0.2),
        *(sheet((-3, y, 0), (3, y, 2.6), 0.12) for y in (-2, 3)),
        *(sheet((x, -2, 0), (x, 3, 2.6), 0.1) for x in (-3, 3)),
        sheet((1, 1, 0.7), (2, 2, 0.7), 0.06),
    ]
    xyz = np.concatenate(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))
    return (xyz - [0, 0, 0.5]).astype(np.float32)


def pcd(path: Path, xyz: F32, intensity: F32 | None = None) -> Path:
    """Write a binary PCD, as SLAM programs do."""
    names = "x y z" + (" intensity" if intensity is not None else "")
    columns = xyz if intensity is None else np.column_stack([xyz, intensity])
    count = columns.shape[1]
    head = (
        f"VERSION 0.7\nFIELDS {names}\nSIZE{' 4' * count}\nTYPE{' F' * count}\nCOUNT{' 1' * count}\n"
        f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + columns.astype(np.float32).tobytes())
    return path


def with_nan(xyz: F32) -> F32:
    xyz = xyz.copy()
    xyz[::7] = np.nan
    return xyz


def one_ring(xyz: F32) -> F32:
    """Only points near one cone of a lidar: a ring on the walls, none on the floor."""
    elevation = xyz[:, 2] / np.maximum(np.linalg.norm(xyz[:, :2], axis=1), 1e-6)
    return xyz[np.abs(elevation) < 0.06]


CASES: dict[str, Callable[[F32], F32]] = {
    "whole": lambda xyz: xyz,
    "nan": with_nan,
    "duplicates": lambda xyz: np.concatenate([xyz, xyz[::2], xyz[::3]]),
    "few": lambda xyz: xyz[:: len(xyz) // 1100],
    "floor": lambda xyz: xyz[xyz[:, 2] < -0.4],
    "walls": lambda xyz: xyz[(xyz[:, 2] > -0.4) & (xyz[:, 2] < 2.0)],
    "ceiling": lambda xyz: xyz[xyz[:, 2] > 2.0],
    "ring": lambda xyz: np.concatenate([one_ring(xyz + np.float32(shift)) for shift in np.arange(-4, 4) / 50]),
    "line": lambda xyz: xyz * np.array([1, 0, 0], np.float32),
    "one point": lambda xyz: np.repeat(xyz[:1], 2000, axis=0),
    "far": lambda xyz: xyz + np.array([4e5, 5e6, 100], np.float32),
}
IN_MAKE_TEST = {"whole", "walls", "line"}


@pytest.mark.parametrize("case", [c if c in IN_MAKE_TEST else pytest.param(c, marks=pytest.mark.slow) for c in CASES])
def test_map_in_any_state_ends_in_a_world_or_a_reason(tmp_path: Path, case: str) -> None:
    source = pcd(tmp_path / "map.pcd", CASES[case](room()))
    code, printed = scan2sim("run", source, "--out", tmp_path / "out", *FAST)
    assert "Traceback" not in printed
    assert code in (0, DATA_ERROR), printed
    if code == 0:
        about = json.loads((tmp_path / "out" / "world" / "metadata.json").read_text(encoding="utf-8"))
        assert about["groups"]
        report = html.unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
        assert ("From the robot's eye" in report) == ("spawn" in about.get("navigation", {}))
    else:
        assert "needs" in printed, printed


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_random_parts_of_a_map_end_in_a_world_or_a_reason(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = room(seed=seed)
    box = rng.uniform((-3, -2, -0.5), (3, 3, 2.1), (2, 3))
    inside = np.all((xyz > box.min(axis=0)) & (xyz < box.max(axis=0)), axis=1)
    kept = xyz[~inside & (rng.random(len(xyz)) < rng.uniform(0.1, 1))]
    intensity = rng.uniform(0, 255, len(kept)).astype(np.float32) if seed % 2 else None
    code, printed = scan2sim("run", pcd(tmp_path / "map.pcd", kept, intensity), "--out", tmp_path / "out", *FAST)
    assert "Traceback" not in printed and code in (0, DATA_ERROR), printed


@pytest.fixture(scope="module")
def office() -> RobotMap:
    """Map of a corridor with two furnished rooms, with the kind of each point."""
    building = build(3, Style(rooms=1, furniture=0.4))
    lidar = Lidar(azimuth_step=1.0, elevation=(-25.0, 40.0))
    return record(building, lidar, Mapping(voxel=0.1, people=1, reflections=0.05), 3)


SUBSETS: dict[str, tuple[dict[Surface, float], str]] = {
    "no floor": ({Surface.WALL: 0.5, Surface.CEILING: 1, Surface.FURNITURE: 0.5}, "the up axis is ambiguous"),
    "no walls": ({Surface.FLOOR: 0.7, Surface.CEILING: 0.3, Surface.PERSON: 1}, "no walls found"),
    "traces of the floor": ({Surface.WALL: 0.8, Surface.FLOOR: 0.003}, "is assumed from the feet"),
    "a few of everything": (dict.fromkeys(Surface, 0.08), "of the floor"),
}
"""Share of the points of each kind that is kept, and the warning of `run` about the map."""
SPAWN_TOLERANCE_M = 0.2


@pytest.mark.parametrize("case", SUBSETS)
def test_subsets_of_a_maps_classes_end_in_an_upright_world(tmp_path: Path, office: RobotMap, case: str) -> None:
    shares, expected = SUBSETS[case]
    share = np.array([shares.get(Surface(kind), 0) for kind in range(1, len(Surface) + 1)])
    kept = np.random.default_rng(0).random(len(office.xyz)) < share[office.surface - 1]
    source = pcd(tmp_path / "map.pcd", office.xyz[kept].astype(np.float32))
    code, printed = scan2sim("run", source, "--out", tmp_path / "out", *FAST)
    assert code == 0 and "Traceback" not in printed and expected in printed, printed
    about = json.loads((tmp_path / "out" / "world" / "metadata.json").read_text(encoding="utf-8"))
    T = np.array(about["T_world_map"])
    assert np.degrees(np.arccos(T[:3, :3] @ office.up @ (0, 0, 1))) < 2
    (x, y, z), to_building = about["navigation"]["spawn"]["position_m"], np.linalg.inv(T @ office.T_map_world)
    assert abs((to_building @ (x, y, z, 1))[2]) < SPAWN_TOLERANCE_M  # its floor is at height 0


def test_folder_of_clouds_and_a_repeated_run(tmp_path: Path) -> None:
    xyz, folder = room(), tmp_path / "maps"
    folder.mkdir()
    rgb: U8 = np.full((len(xyz), 3), 90, np.uint8)
    for i in range(2):
        las.write(folder / f"part{i}.laz", PointCloud(Frame(), xyz[i::2], rgb[i::2]))
    code, printed = scan2sim("run", folder, "--out", tmp_path / "out", *FAST)
    assert code == 0 and "Traceback" not in printed, printed
    assert json.loads((tmp_path / "out" / "world" / "metadata.json").read_text(encoding="utf-8"))["groups"]
    code, printed = scan2sim("run", folder, "--out", tmp_path / "out", *FAST)
    assert code == 0 and "nothing to do" in printed


@pytest.mark.slow
def test_points_of_a_tilted_map_in_millimetres_lie_on_the_world(tmp_path: Path) -> None:
    xyz = room(30_000)
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    c, s = np.cos(np.radians(7)), np.sin(np.radians(7))
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ y_up
    source = pcd(tmp_path / "map.pcd", (1000 * xyz @ R.T).astype(np.float32))
    assert scan2sim("run", source, "--units", "mm", "--out", tmp_path / "out", *FAST)[0] == 0
    world = tmp_path / "out" / "world"
    about = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    T = np.array(about["T_world_map"])
    assert about["map_unit_m"] == 0.001 and about["world_origin_m"] == [0, 0, 0]
    assert np.degrees(np.arccos((T[:3, :3] @ R)[2, 2])) < 1  # level
    scene = read_scene(world)
    meshes = [surface.shape.mesh.moved_to(scene.frame) for surface in scene.tiles[0].surfaces()]
    for points in (clouds.read(source, Frame()).xyz, clouds.read(world / "map.pcd", Frame()).xyz):
        placed = (0.001 * points[::20] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        nearest = np.min([distances(placed, mesh) for mesh in meshes], axis=0)
        assert np.median(nearest) < 0.03 and np.percentile(nearest, 90) < 0.15  # the table is dropped
    x, y, z = about["navigation"]["spawn"]["position_m"]
    assert z == pytest.approx(-0.48, abs=0.06) and np.hypot(x, y) < 1.5
    assert (world / "map.launch.py").is_file() and (world / "map.yaml").is_file()
