"""Occupancy maps against the true free space of synthetic buildings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scan2sim.data_samples.building import Building, Style, Surface, build
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Frame, Mesh
from scan2sim.pipeline.simulation.free_spawn import spawn_pose
from scan2sim.pipeline.simulation.occupancy import EDGE_M, FREE, OCCUPIED, Band, Storey, storeys
from scan2sim.pipeline.simulation.robot import ROBOT
from scan2sim.pipeline.simulation.spans import Grid, spans_of
from scan2sim.pipeline.steps.navigation import NavigationParams
from tests.fakes.boxes import box, joined

NOWHERE: F64 = np.zeros((0, 3))


LOW_ROBOT = Band(high=0.6, radius=0.25)


def agreement(storey: Storey, building: Building, k: int, band: Band) -> tuple[float, float]:
    """Share of the free space of storey `k` that the robot truly reaches that is free; share of falsely free cells."""
    truth = building.free_space(k, low=band.low, high=band.high)
    centres = storey.grid.centres(np.arange(storey.occupancy.size))
    way = np.concatenate(building.routes)
    (start, *_) = way[np.abs(way[:, 2] - building.floors[k]) < 0.1]
    reached, found = truth.swept(start[:2], band.radius).at(centres), storey.free.ravel()
    return float(found[reached].mean()), float((found & ~truth.at(centres)).sum() / found.sum())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_path", [True, False])
@pytest.mark.parametrize("band", [Band(), LOW_ROBOT], ids=["supplied", "low"])
def test_free_space_of_a_building_is_correct(seed: int, with_path: bool, band: Band) -> None:
    building = build(seed, Style(rooms=3))
    path = building.routes[0] + (0, 0, 0.5) if with_path else NOWHERE
    (storey,) = storeys(building.mesh, path, band)
    right, wrong = agreement(storey, building, 0, band)
    assert right > 0.96 and wrong < 0.02, (right, wrong)
    assert storey.height == pytest.approx(building.floors[0], abs=0.01)


def test_orientation_of_the_faces_does_not_matter() -> None:
    building = build(0, Style(rooms=2))
    mesh = replace(building.mesh, faces=building.mesh.faces[:, ::-1].copy())
    (storey, *_) = storeys(mesh, building.routes[0] + (0, 0, 0.5))
    assert agreement(storey, building, 0, Band())[0] > 0.95


def test_each_storey_has_a_map_with_that_of_the_start_first() -> None:
    building = build(2, Style(storeys=2, stairs=True))
    upper = building.routes[0][building.routes[0][:, 2] > building.floors[1] - 0.01] + (0, 0, 0.5)
    found = storeys(building.mesh, upper)
    assert [one.height for one in found] == pytest.approx([building.floors[1], building.floors[0]], abs=0.02)
    for one, k in zip(found, (1, 0), strict=True):
        assert agreement(one, building, k, Band())[0] > 0.95


def test_surfaces_outside_the_height_band_are_not_obstacles() -> None:
    floor = box((0, 0, -0.1), (6, 4, 0))
    low, beam, post = box((1, 1, 0), (1.5, 1.5, 0.05)), box((2, 0, 1), (2.2, 4, 1.2)), box((3.98, 2, 0), (4.2, 2.2, 1))
    (storey,) = storeys(joined(floor, low, beam, post), np.array([[0.5, 0.5, 0.5]]))

    def values(x: float, y: float) -> tuple[bool, bool]:
        index = int(storey.grid.index(np.array([[x, y]]))[0])
        return bool(storey.free.ravel()[index]), bool(storey.occupancy.ravel()[index] == OCCUPIED)

    assert values(1.22, 1.22) == (True, False) and values(2.12, 2.02) == (True, False)
    assert values(3.98, 2.12) == (False, True) and values(3, 3) == (True, False)
    assert values(4.1, 2.1) == (False, False)  # inside the post


def test_bar_that_the_supplied_robot_would_hit_is_an_obstacle() -> None:
    floor, bar, above = box((0, 0, -0.1), (6, 4, 0)), box((2, 1, 0.7), (2.1, 3, 0.75)), box((4, 1, 0.8), (4.1, 3, 0.9))
    (storey,) = storeys(joined(floor, bar, above), np.array([[0.5, 0.5, 0.5]]))
    index = storey.grid.index(np.array([[2.03, 2.03], [4.03, 2.03]]))
    assert storey.occupancy.ravel()[index].tolist() == [OCCUPIED, FREE]


def test_height_band_and_passages_fit_the_supplied_robot() -> None:
    low, high = ROBOT.extent
    assert Band.high > high[2] and Band.radius > max(-low[1], high[1])
    params = NavigationParams()
    assert Band() == Band(params.low, params.high, params.max_step, params.max_slope, params.radius)


def test_floor_behind_a_passage_that_is_too_narrow_is_unknown() -> None:
    walls = [box((3, 0, 0), (3.1, 1.8, 2)), box((3, 2.2, 0), (3.1, 4, 2))]  # 40 cm between them
    floor = box((0, 0, -0.1), (3.6, 4, 0))
    mesh, start = joined(floor, *walls), np.array([[1.0, 1.0, 0.5]])
    behind = [storeys(mesh, start, Band(radius=r))[0] for r in (0.1, 0.25)]
    index = int(behind[0].grid.index(np.array([[3.4, 2.0]]))[0])
    assert behind[0].free.ravel()[index]
    free = behind[1].free
    assert free[:, int((3.4 - behind[1].grid.origin[0]) / behind[1].grid.cell)].sum() == 0


def test_sloping_ground_is_floor_and_its_walls_are_obstacles() -> None:
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0, 20, 41), np.linspace(0, 6, 13), indexing="ij"))
    vertices = np.column_stack([x, y, 0.1 * x]).astype(np.float32)
    a = (np.arange(40)[:, None] * 13 + np.arange(12)).ravel()
    faces = np.concatenate([np.stack([a, a + 13, a + 14], 1), np.stack([a, a + 14, a + 1], 1)]).astype(np.int32)
    ramp = Mesh(Frame(), vertices, faces)
    (storey,) = storeys(joined(ramp, box((10, 2, 0), (10.2, 4, 3))), np.array([[1.0, 1.0, 1.0]]))
    assert storey.free_m2 == pytest.approx((20 - 2 * EDGE_M) * (6 - 2 * EDGE_M), rel=0.03)
    index = int(storey.grid.index(np.array([[10.02, 3.02]]))[0])
    assert storey.occupancy.ravel()[index] == OCCUPIED
    start = spawn_pose(storey, np.array([3.0, 3.0, 0.5])).start
    assert start.position[2] == pytest.approx(0.1 * start.position[0] + 0.02, abs=0.02)
    assert np.hypot(*start.angles[:2]) == pytest.approx(np.arctan(0.1), abs=0.01)


def test_cells_near_a_floor_edge_without_a_wall_are_not_free() -> None:
    floor, wall = box((0.02, 0.02, -0.1), (3.98, 2.98, 0)), box((0.02, 0.02, 0), (0.1, 2.98, 1))
    (storey,) = storeys(joined(floor, wall), np.array([[1.0, 1.0, 0.5]]))
    centre = storey.grid.centres(np.flatnonzero(storey.free))
    assert centre[:, 0].min() < 0.15 + storey.grid.cell  # beside the wall
    assert centre[:, 0].max() < 3.98 - EDGE_M and centre[:, 1].max() < 2.98 - EDGE_M
    assert storey.free_m2 == pytest.approx((3.95 - EDGE_M - 0.1) * (2.9 - 2 * EDGE_M), rel=0.03)


def test_cells_that_floor_covers_partly_are_not_free() -> None:
    """Floor beside a gap of 2 cm within a cell."""
    halves = box((0, 0, -0.1), (2.01, 3, 0)), box((2.03, 0, -0.1), (4, 3, 0))
    (storey,) = storeys(joined(*halves), np.array([[1.0, 1.0, 0.5]]), Band(radius=0.1))
    index = storey.grid.index(np.array([[2.02, 1.5]]))
    assert not storey.free.ravel()[index].any()


def test_only_ground_is_floor_if_it_is_known() -> None:
    floor, platform = box((0, 0, -0.1), (6, 4, 0)), box((2, 1, 0), (4, 3, 0.05))
    mesh = joined(floor, platform, box((0, 0, 2.5), (6, 4, 2.6)))
    ground = np.arange(len(mesh)) < 12
    (storey,) = storeys(mesh, NOWHERE, ground=ground)
    assert storey.free_m2 == pytest.approx((6 - 2 * EDGE_M) * (4 - 2 * EDGE_M), rel=0.01)
    assert np.nanmax(storey.floor) == 0
    assert np.nanmax(storeys(mesh, NOWHERE)[0].floor) == pytest.approx(0.05)


def test_walls_without_a_floor_are_an_error() -> None:
    building = build(0, Style(rooms=2))
    with pytest.raises(DataError, match="floor"):
        storeys(building.only(Surface.WALL).keep(np.abs(building.only(Surface.WALL).face_normal[:, 2]) < 0.5), NOWHERE)


def test_spans_hold_the_exact_heights_of_a_triangle() -> None:
    rng = np.random.default_rng(0)
    mesh = Mesh(Frame(), rng.uniform(0, 1, (3, 3)).astype(np.float32), np.array([[0, 1, 2]], np.int32))
    spans = spans_of(mesh, Grid((0.0, 0.0), 0.1, (10, 10)))
    weights = rng.dirichlet(np.ones(3), 200_000)
    points = weights @ mesh.vertices
    cell = Grid((0.0, 0.0), 0.1, (10, 10)).index(points[:, :2])
    for index in np.unique(cell):
        z = points[cell == index, 2]
        (k,) = np.flatnonzero(spans.cell == index)
        assert spans.low[k] <= z.min() + 1e-6 and spans.high[k] >= z.max() - 1e-6
        if len(z) > 1000:
            assert (spans.low[k], spans.high[k]) == pytest.approx((z.min(), z.max()), abs=0.02)
