"""Import of robot maps: up axis, tilt, units, outliers, frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scan2sim.data_samples.building import Style, Surface, build
from scan2sim.flows.commands.inspect_map import map_facts
from scan2sim.pipeline.core.types import F32, F64, Frame, PointCloud
from scan2sim.pipeline.geometry.surface_distance import sample_surface
from scan2sim.pipeline.geometry.upright import find_up, rotation_to_z
from scan2sim.pipeline.importers import large_maps
from scan2sim.pipeline.importers.robot_map import AXES, MapParams, import_map, map_files
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present

SENSOR_HEIGHT_M = 0.6


def room(seed: int = 0, noise: float = 0.02, ceiling: bool = True, floor: bool = True) -> F32:
    """Points of a furnished room of 8 x 6 x 2.8 m in the axes of a sensor that starts level in it."""
    rng = np.random.default_rng(seed)

    def sheet(low: tuple[float, ...], high: tuple[float, ...], count: int) -> F64:
        return rng.uniform(low, high, (count, 3))

    parts = [sheet((-3, y, 0), (5, y, 2.8), 4000) for y in (-2.0, 4.0)]
    parts += [sheet((x, -2, 0), (x, 4, 2.8), 3000) for x in (-3.0, 5.0)]
    parts += [sheet((-3, -2, 0), (5, 4, 0), 8000)] if floor else []
    parts += [sheet((-3, -2, 2.8), (5, 4, 2.8), 5000)] if ceiling else []
    parts += [sheet((2, 1, 0.7), (3.5, 2, 0.7), 600), sheet((-3, 2, 0), (-2.6, 2, 1.8), 500)]
    xyz = np.concatenate(parts) + rng.normal(0, noise, (sum(map(len, parts)), 3))
    return (xyz - [0, 0, SENSOR_HEIGHT_M]).astype(np.float32)


def save(path: Path, xyz: F32) -> Path:
    las.write(path, PointCloud(Frame(), xyz))
    return path


def imported(path: Path, out: Path, **options: str) -> tuple[F64, F64, list[str]]:
    """World points, T_world_map and warnings of an imported map."""
    warnings: list[str] = []
    tile = read_tile(import_map([path], out, MapParams.of("", options), warn=warnings.append))
    cloud = clouds.read(tile.clouds[0], Frame())
    return cloud.xyz.astype(np.float64), present(tile.robot_map).T_world_map, warnings


@pytest.mark.parametrize("seed", range(8))
def test_up_axis_is_found_in_any_orientation(seed: int) -> None:
    turn = Rotation.random(random_state=seed).as_matrix()
    found = present(find_up((room(seed) @ turn.T).astype(np.float32)))
    assert np.degrees(np.arccos(found.up @ turn[:, 2])) < 0.5


@pytest.mark.parametrize("parts", [{"ceiling": False}, {"floor": False, "ceiling": False}])
def test_up_axis_is_found_without_ceiling_or_floor(parts: dict[str, bool]) -> None:
    turn = Rotation.random(random_state=3).as_matrix()
    found = present(find_up((room(1, **parts) @ turn.T).astype(np.float32)))
    assert np.degrees(np.arccos(found.up @ turn[:, 2])) < 0.5


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
def test_map_with_a_ceiling_whose_floor_was_removed_stays_upright(tmp_path: Path, tilt_deg: float) -> None:
    """The ceiling alone could be a floor: the map's z axis decides, with a warning."""
    turn = Rotation.from_euler("x", tilt_deg, degrees=True)
    source = save(tmp_path / "map.las", turn.apply(room(2, floor=False)).astype(np.float32))
    _, T, warnings = imported(source, tmp_path / "tile")
    up = T[:3, :3] @ turn.as_matrix()[:, 2]
    assert np.degrees(np.arccos(up[2])) < 0.5
    assert any("ambiguous" in warning and "--up" in warning for warning in warnings)


def office(*surfaces: Surface, seed: int) -> F32:
    """Points on surfaces of an office in the axes of a sensor that starts level in it."""
    building = build(seed, Style(rooms=3))
    points = sample_surface(building.only(*surfaces), 40_000, seed)
    noise = np.random.default_rng(seed).normal(0, 0.02, points.shape)
    return (points + noise - building.routes[0][0] - [0, 0, SENSOR_HEIGHT_M]).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_furniture_without_a_floor_is_ambiguous(tmp_path: Path, seed: int) -> None:
    """Table tops would be a floor if furniture was on its head."""
    turn = Rotation.random(random_state=seed)
    floor = (Surface.FLOOR, Surface.CEILING)
    whole = present(find_up(turn.apply(office(Surface.FURNITURE, *floor, seed=seed)).astype(np.float32)))
    assert np.degrees(np.arccos(whole.up @ turn.as_matrix()[:, 2])) < 0.5 and not whole.ambiguous
    furniture = turn.apply(office(Surface.FURNITURE, seed=seed)).astype(np.float32)
    _, _, warnings = imported(save(tmp_path / "map.las", furniture), tmp_path / "tile")
    assert any("ambiguous" in warning and "--up" in warning for warning in warnings)
    assert "ambiguous" in dict(map_facts(PointCloud(Frame(), furniture)))["up axis"]


@pytest.mark.parametrize("seed", range(4))
def test_ground_far_below_the_sensor_is_no_ceiling(seed: int) -> None:
    """A lorry's sensor is further from the road than from the top of what stands beside it."""
    rng = np.random.default_rng(seed)
    road = rng.uniform((-40, -8, -2.4), (40, 8, -2.4), (20_000, 3))
    walls = [rng.uniform((-40, y, -2.4), (40, y, 0.8), (6_000, 3)) for y in (-8.0, 8.0)]
    xyz = np.concatenate([road, *walls]) + rng.normal(0, 0.02, (32_000, 3))
    turn = Rotation.random(random_state=seed)
    found = present(find_up(turn.apply(xyz).astype(np.float32)))
    assert np.degrees(np.arccos(found.up @ turn.as_matrix()[:, 2])) < 0.5


def test_tilted_map_becomes_level_and_its_transform_maps_it_to_the_world(tmp_path: Path) -> None:
    xyz = room()
    tilt = Rotation.from_euler("xyz", [7, -6, 20], degrees=True).as_matrix()
    world, T, warnings = imported(save(tmp_path / "map.las", (xyz @ tilt.T).astype(np.float32)), tmp_path / "tile")
    floor = world[world[:, 2] < -SENSOR_HEIGHT_M + 0.1]
    assert np.ptp(np.percentile(floor[:, 2], (2, 98))) < 0.15
    mapped = (xyz @ tilt.T) @ T[:3, :3].T
    from scipy.spatial import cKDTree

    assert cKDTree(mapped).query(world)[0].max() < 0.005
    assert any("tilted by" in text for text in warnings)


@pytest.mark.parametrize("up", ["y", "-y", "x", "-z"])
def test_level_map_with_another_up_axis_is_turned_by_right_angles_only(up: str, tmp_path: Path) -> None:
    """As of a map whose z axis is up, a tilt that is smaller than the noise is kept."""
    turn = rotation_to_z(np.array(AXES[up], np.float64))
    xyz = (room() @ turn).astype(np.float32)
    assert not np.array_equal(present(find_up(xyz)).up, AXES[up])
    _, T, warnings = imported(save(tmp_path / "map.las", xyz), tmp_path / "tile")
    assert np.array_equal(T[:3, :3], turn)
    assert f"up is the map's {up} axis" in warnings


def test_map_in_coordinates_of_a_survey_has_z_up(tmp_path: Path) -> None:
    """Roofs from the air, sparse ground below: by its surfaces alone, the map would be on its head."""
    rng = np.random.default_rng(0)
    roofs, ground = (rng.uniform((-40, -40, z), (40, 40, z), (n, 3)) for z, n in ((12.0, 8000), (0.0, 500)))
    xyz = np.concatenate([roofs, ground]) + rng.normal(0, 0.02, (8500, 3))
    corner = (674_521.0, 1_206_740.0, 627.0)
    assert present(find_up(xyz.astype(np.float32), -np.array(corner))).up[2] < 0
    las.write(tmp_path / "survey.las", PointCloud(Frame(origin=corner), xyz.astype(np.float32)))
    world, T, warnings = imported(tmp_path / "survey.las", tmp_path / "tile")
    assert np.array_equal(T, np.eye(4)) and np.abs(np.median(world, axis=0) - (xyz.mean(axis=0) + corner))[2] < 2
    assert any("survey" in warning for warning in warnings)
    facts = dict(map_facts(PointCloud(Frame(origin=corner), xyz.astype(np.float32))))
    assert facts["up axis"].startswith("z") and "outdoor" in facts["scene"]


def test_level_map_keeps_its_coordinates(tmp_path: Path) -> None:
    xyz = room()
    world, T, _ = imported(save(tmp_path / "map.las", xyz), tmp_path / "tile")
    assert np.array_equal(T, np.eye(4))
    assert set(map(tuple, world.round(3).tolist())) <= set(map(tuple, xyz.astype(np.float64).round(3).tolist()))


def test_millimetres_are_recognized(tmp_path: Path) -> None:
    xyz = 1000 * (room() + np.array([40, 0, 0], np.float32))  # so far from the start that its origin is shifted
    world, _, warnings = imported(save(tmp_path / "map.las", xyz), tmp_path / "tile")
    assert world.min(axis=0) == pytest.approx([37, -2, -SENSOR_HEIGHT_M], abs=0.2)
    assert np.ptp(world[:, 0]) == pytest.approx(8, abs=0.2)
    assert any("coordinates are in mm" in text for text in warnings)


def test_cloud_with_a_crs_in_feet_keeps_its_coordinates(tmp_path: Path) -> None:
    """EPSG:2992 is in international feet; a georeferenced cloud is level by definition."""
    frame = Frame("EPSG:2992", (200_000.0, 300_000.0, 0.0), 0.3048)
    las.write(tmp_path / "map.laz", PointCloud(frame, room()))
    tile = read_tile(import_map([tmp_path / "map.laz"], tmp_path / "tile", MapParams()))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert tile.frame.unit == pytest.approx(0.3048) and np.ptp(cloud.xyz[:, 0]) == pytest.approx(8, abs=0.2)
    assert np.median(cloud.xyz[:, 0]) + tile.frame.origin[0] == pytest.approx(200_001, abs=1)


def test_far_returns_and_reflections_below_the_floor_are_removed(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    far = rng.uniform(-60, 60, (60, 3)) + [0, 0, 80]
    mirrored = np.column_stack([rng.uniform(-2, 4, 300), rng.uniform(-1, 3, 300), rng.uniform(-2.5, -1.1, 300)])
    xyz = np.concatenate([room(), far, mirrored]).astype(np.float32)
    world, _, warnings = imported(save(tmp_path / "map.las", xyz), tmp_path / "tile", scene="indoor")
    assert np.ptp(world, axis=0) == pytest.approx([8, 6, 2.8], abs=0.35)
    assert sum("removed" in text for text in warnings) == 2


def test_given_up_axis_overrides_the_estimate(tmp_path: Path) -> None:
    world, T, _ = imported(save(tmp_path / "map.las", room()), tmp_path / "tile", up="-z")
    assert T[2, 2] == pytest.approx(-1, abs=0.01)
    assert world[:, 2].max() == pytest.approx(SENSOR_HEIGHT_M, abs=0.1)


def test_indoor_scene_is_recognized(tmp_path: Path) -> None:
    imported(save(tmp_path / "map.las", room()), tmp_path / "tile")
    assert present(read_tile(tmp_path / "tile").robot_map).scene == "indoor"


def test_one_point_far_away_changes_nothing(tmp_path: Path) -> None:
    xyz = room()
    stray = np.concatenate([xyz, np.array([[3e5, -2e5, 50]], np.float32)])
    points, T, warnings = imported(save(tmp_path / "stray.las", stray), tmp_path / "tile")
    assert np.array_equal(T, np.eye(4)) and points.shape == xyz.shape
    assert np.abs(points - xyz).max() < 0.002
    assert any("far points removed" in text for text in warnings)


def test_map_that_memory_does_not_hold_is_thinned_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_maps, "MAX_POINTS", 20_000)
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 7_000)
    (tmp_path / "map").mkdir()
    parts = [room(seed) for seed in range(4)]
    far = np.array([[1e5, -1e5, 30]], np.float32)  # its cube has no number of 64 bits
    for i, xyz in enumerate(parts):
        save(tmp_path / "map" / f"{i}.las", np.concatenate([far, xyz]) if i == 1 else xyz)
    warnings: list[str] = []
    tile = read_tile(import_map(map_files(tmp_path / "map"), tmp_path / "tile", MapParams(), warn=warnings.append))
    cloud = clouds.read(tile.clouds[0], Frame())
    assert 8_000 < len(cloud) <= 20_000
    (text,) = (text for text in warnings if "thinned" in text)
    assert text.startswith(f"{sum(map(len, parts)) + 1:,} points were thinned to ")
    side = float(text.split("cube of ")[1].split()[0])
    gaps = cKDTree(cloud.xyz).query(np.concatenate(parts))[0]
    assert gaps.max() < 1.8 * side  # the diagonal of a cube
    assert cKDTree(np.concatenate(parts)).query(cloud.xyz)[0].max() < 0.002  # points of the map, not means


def test_folder_without_clouds_is_an_error(tmp_path: Path) -> None:
    from scan2sim.pipeline.core.errors import InputError

    with pytest.raises(InputError, match="neither a tile.toml nor point clouds"):
        map_files(tmp_path)


@pytest.mark.parametrize(("name", "up"), [("hdl501", (0.13, -0.10, 0.99)), ("lobby", (0, 0, 1)), ("dddmr", (0, 1, 0))])
def test_up_axis_of_real_maps_is_found(real_data: Path, name: str, up: tuple[float, ...]) -> None:
    cloud = clouds.read(real_data / "slam_maps" / f"{name}.pcd", Frame())
    found = present(find_up(cloud.xyz))
    assert np.degrees(np.arccos(np.clip(found.up @ up / np.linalg.norm(up), -1, 1))) < 2.5


def test_rotation_to_z_is_a_rotation() -> None:
    for up in (np.array([0, 0, -1.0]), np.array([0, 0, 1.0]), np.array([0.6, 0, -0.8])):
        R = rotation_to_z(up)
        assert np.allclose(R @ up, [0, 0, 1]) and np.linalg.det(R) == pytest.approx(1)
