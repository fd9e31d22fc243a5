"""Floor maps compared with the true floors of synthetic rooms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, Frame, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.terrain.floor_map import FloorMap, floor_map
from scan2sim.pipeline.terrain.floor_mesh import triangulate

SIZE = 6.0
RNG = np.random.default_rng(3)


def level(low: tuple[float, float], high: tuple[float, float], z: float = 0.0, spacing: float = 0.08) -> F64:
    """Points of a level rectangle."""
    x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def walls(z: float = 0.0, height: float = 2.5, size: float = SIZE) -> F64:
    """Points of the four walls of a square room."""
    along, up = (part.ravel() for part in np.meshgrid(np.arange(0, size, 0.08), np.arange(0.05, height, 0.08)))
    sides = [(along, 0 * along), (along, 0 * along + size), (0 * along, along), (0 * along + size, along)]
    return np.concatenate([np.column_stack([*side, z + up]) for side in sides])


def noisy(xyz: F64, sigma: float = 0.01) -> F32:
    return (xyz + np.random.default_rng(1).normal(0, sigma, xyz.shape)).astype(np.float32)


def find(ground: Any, others: Any, **options: Any) -> FloorMap:
    options = {"spacing": 0.08, "gap": 1.5, "level": True} | options
    return floor_map(np.asarray(ground, np.float32), np.asarray(others, np.float32), **options)


def heights(found: FloorMap, xy: F64, storey: int = 0) -> F64:
    return found.storeys[storey].height[found.raster.at(xy)]


def inside(count: int = 2000, margin: float = 0.1, size: float = SIZE) -> F64:
    """Random positions in the room."""
    return RNG.uniform(margin, size - margin, (count, 2))


def mesh_of(found: FloorMap, storey: int = 0) -> Mesh:
    return triangulate(found.raster, found.storeys[storey].height, 0.02, Frame())


def test_hole_in_the_scan_is_filled_and_marked() -> None:
    ground = level((0, 0), (SIZE, SIZE))
    hole = (np.abs(ground[:, :2] - 3) < 1.0).all(axis=1)
    found = find(noisy(ground[~hole]), noisy(walls()))
    assert np.abs(heights(found, inside())).max() < 0.02
    assumed = ~found.storeys[0].scanned[found.raster.at(np.array([[3.0, 3.0], [1.0, 1.0]]))]
    assert assumed.tolist() == [True, False]
    assert found.assumed_share == pytest.approx(1.5**2 / SIZE**2, abs=0.03)
    assert len(mesh_of(found)) < 60


def test_floor_ends_at_the_walls() -> None:
    far = noisy(level((20, 20), (20.3, 20.3), 1.5))  # seen through a window
    found = find(noisy(level((0, 0), (SIZE, SIZE))), np.concatenate([noisy(walls()), far]))
    assert found.area < (SIZE + 0.3) ** 2


@pytest.mark.parametrize("scanned", [True, False])
def test_no_floor_is_assumed_behind_the_walls(scanned: bool) -> None:
    """The gap between two rooms with a common corner, outside of both, is narrow enough to be closed."""
    rooms = [walls(size=3.0), walls(size=3.0) + [3.0, 3.0, 0.0]]
    ground = np.concatenate([level((0, 0), (3, 3)), level((3, 3), (6, 6))]) if scanned else np.zeros((0, 3))
    found = find(noisy(ground), noisy(np.concatenate(rooms)))
    indoors = np.concatenate([inside(margin=0.2, size=3.0), inside(margin=0.2, size=3.0) + 3.0])
    assert np.isfinite(heights(found, indoors)).all()
    behind = np.column_stack([RNG.uniform(3.25, 6, 500), RNG.uniform(0, 2.75, 500)])
    assert np.isnan(heights(found, np.concatenate([behind, behind[:, ::-1]]))).all()


def test_map_without_ground_gets_a_floor_at_the_bottom_of_its_walls() -> None:
    found = find(np.zeros((0, 3)), noisy(walls()))
    assert found.filtered and found.assumed_share == 1
    assert np.abs(heights(found, inside())).max() < 0.1
    assert (SIZE - 0.2) ** 2 < found.area < (SIZE + 0.8) ** 2


def test_wall_bottoms_classified_as_ground_do_not_prevent_a_floor_from_walls() -> None:
    """Half of the walls are classified as walls; the lowest 70 cm of the others as ground."""
    all_walls = noisy(walls())
    feet = (all_walls[:, 0] > SIZE / 2) & (all_walls[:, 2] < 0.7)
    found = find(all_walls[feet], all_walls[all_walls[:, 0] < SIZE / 2])
    assert found.filtered
    assert np.isfinite(heights(found, inside(margin=0.3))).mean() > 0.95


def test_sensor_path_gives_the_floor_of_a_map_without_ground() -> None:
    path = np.column_stack([np.linspace(1, 5, 50), np.full(50, 3.0), np.full(50, 0.6)]).astype(np.float32)
    found = find(np.zeros((0, 3)), noisy(walls()), path=path)
    assert found.sensor_height == pytest.approx(0.55, abs=0.06)
    assert np.abs(heights(found, inside())).max() < 0.1


def test_sensor_height_is_measured_over_scanned_ground() -> None:
    path = np.column_stack([np.linspace(1, 5, 50), np.full(50, 3.0), np.full(50, 0.6)]).astype(np.float32)
    assert find(noisy(level((0, 0), (SIZE, SIZE))), noisy(walls()), path=path).sensor_height == pytest.approx(
        0.6, abs=0.02
    )


def test_spikes_pits_and_furniture_do_not_change_the_floor() -> None:
    ground = noisy(level((0, 0), (SIZE, SIZE)))
    noise = np.column_stack([inside(60, 0.5), RNG.uniform(-0.25, 0.28, 60)]).astype(np.float32)
    table = noisy(level((2, 2), (3.2, 2.8), 0.72))
    clear = ground[~((ground[:, :2] > [2, 2]) & (ground[:, :2] < [3.2, 2.8])).all(axis=1)]
    found = find(np.concatenate([clear, noise, table]), noisy(walls()))
    assert np.abs(heights(found, inside())).max() < 0.04


def test_kerb_is_kept() -> None:
    ground = np.concatenate([level((0, 0), (3, SIZE)), level((3, 0), (SIZE, SIZE), 0.15)])
    found = find(noisy(ground), np.zeros((0, 3)), level=False)
    xy = inside()
    xy = xy[np.abs(xy[:, 0] - 3) > 0.15]
    assert np.abs(heights(found, xy) - np.where(xy[:, 0] > 3, 0.15, 0)).max() < 0.03


def test_ramp_outdoors_keeps_its_slope() -> None:
    ground = level((0, 0), (20, SIZE), spacing=0.1)
    ground[:, 2] = 0.15 * (ground[:, 0] - 5).clip(0, 10)
    shadow = (np.abs(ground[:, :2] - [10, 3]) < 0.8).all(axis=1)
    found = find(noisy(ground[~shadow]), np.zeros((0, 3)), level=False, spacing=0.1)
    xy = RNG.uniform([0.2, 0.2], [19.8, SIZE - 0.2], (3000, 2))
    assert np.abs(heights(found, xy) - 0.15 * (xy[:, 0] - 5).clip(0, 10)).max() < 0.05


def test_two_storeys_are_joined_by_stairs() -> None:
    upper, rise, tread = 2.72, 0.17, 0.27
    steps = np.arange(15)
    stairs = [level((0.5 + tread * k, 4.5), (0.5 + tread * (k + 1), 5.7), rise * (k + 1), 0.05) for k in steps]
    well = level((0, 0), (SIZE, SIZE), upper)
    opening = ((well[:, :2] > [0.5, 4.5]) & (well[:, :2] < [0.5 + tread * 15, 5.7])).all(axis=1)
    ceiling = well[~opening] - [0, 0, 0.25]
    ground = np.concatenate([level((0, 0), (SIZE, SIZE)), *stairs, well[~opening]])
    others = np.concatenate([noisy(ceiling), noisy(walls(0, 5.2))])
    found = find(noisy(ground), others)
    assert len(found.storeys) == 2
    xy = inside()
    xy = xy[xy[:, 1] < 4.2]
    assert np.abs(heights(found, xy)).max() < 0.03
    assert np.abs(heights(found, xy, 1) - upper).max() < 0.03
    middle = np.column_stack([0.5 + tread * (steps + 0.5), np.full(15, 5.1)])
    there = np.array([heights(found, middle, k) for k in (0, 1)])
    assert np.abs(np.nanmin(np.abs(there - rise * (steps + 1)), axis=0)).max() < 0.05
    assert np.isnan(heights(found, middle[:9], 1)).all()  # the stairwell stays open


def test_one_ring_of_points_gets_a_floor() -> None:
    found = find(np.zeros((0, 3)), walls(0.5, 0.1))
    assert (np.abs(heights(found, inside(margin=0.3)) - 0.5) < 0.2).all()


@pytest.mark.parametrize("ground", [np.zeros((0, 3)), [[0.0, 0, 0]], [[0.0, 0, 0], [5, 5, 1], [0, 0, 3]]])
def test_too_few_points_are_accepted(ground: Any) -> None:
    found = find(ground, [[0.0, 0, 2], [1, 1, 1]])
    for k in range(len(found.storeys)):
        mesh_of(found, k)


def test_mesh_is_within_the_tolerance_and_has_no_cracks() -> None:
    ground = level((0, 0), (12, 12))
    ground[:, 2] = 0.2 * np.sin(ground[:, 0]) * np.cos(ground[:, 1] / 2)
    found = find(ground, np.zeros((0, 3)), level=False)
    mesh = mesh_of(found)
    there = found.storeys[0].there
    points = np.column_stack([found.raster.centres(there), found.storeys[0].height[there]]).astype(np.float32)
    assert np.percentile(distances(points, mesh), 99.9) < 0.021
    assert (mesh.face_normal[:, 2] > 0).all()
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    corner, count = np.unique(edges, axis=0, return_counts=True)
    open_ = mesh.vertices[np.unique(corner[count == 1]), :2]
    assert ((open_ < 0.3) | (open_ > 11.7)).any(axis=1).all()
    assert len(mesh) < 2500
