"""What no neighbourhood mends."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.postprocess import by_height, with_feet, without_specks

BUILDING, HIGH, LOW, ROAD, VEHICLE = (
    CLASSES.index(n) for n in ("building", "high_vegetation", "low_vegetation", "road", "vehicle")
)


def sheet(width: float, low: float, high: float, y: float = 0.0) -> np.ndarray:
    """Points 10 cm apart on an upright plane."""
    x, z = np.meshgrid(np.arange(0, width, 0.1), np.arange(low, high, 0.1))
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1).astype(np.float32)


def neighbours(xyz: np.ndarray) -> np.ndarray:
    return cKDTree(xyz).query(xyz, 9)[1][:, 1:].astype(np.int32)


@pytest.mark.parametrize("away", [0.3, 2.0])
def test_a_large_floating_piece_on_a_wall_is_the_walls_and_a_crown_in_the_air_is_not(away: float) -> None:
    wall, piece = sheet(6, 0, 6), sheet(3, 2, 5, away)
    xyz = np.concatenate([wall, piece])
    best = np.repeat([BUILDING, HIGH], [len(wall), len(piece)]).astype(np.uint8)
    found = without_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(wall) :] == (BUILDING if away < 0.5 else HIGH)).all()
    assert (found[: len(wall)] == BUILDING).all()


def test_vegetation_that_stands_on_the_ground_stays_even_on_a_wall() -> None:
    wall, climber = sheet(6, 0, 6), sheet(3, 0, 5, 0.3)
    xyz = np.concatenate([wall, climber])
    best = np.repeat([BUILDING, HIGH], [len(wall), len(climber)]).astype(np.uint8)
    assert (without_specks(best, xyz[:, 2], xyz, neighbours(xyz)) == best).all()


def test_nothing_but_vegetation_stays() -> None:
    xyz = sheet(2, 1, 2)
    best = np.full(len(xyz), HIGH, np.uint8)
    assert (without_specks(best, xyz[:, 2], xyz, neighbours(xyz)) == best).all()


def test_road_in_the_air_is_what_stands_around_it_and_a_ramp_is_road() -> None:
    road, seat, car, ramp = (sheet(4, *z)[:, [0, 2, 1]] for z in ((0, 4), (1, 1.5), (1.5, 2.5), (5, 9)))
    seat[:, 2], car[:, 2], ramp[:, 2] = 1.0, 1.0, 0.3 * (ramp[:, 1] - 5)
    xyz = np.concatenate([road, seat, car, ramp])
    best = np.repeat([ROAD, ROAD, VEHICLE, ROAD], [len(road), len(seat), len(car), len(ramp)]).astype(np.uint8)
    found = without_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(road) :][: len(seat)] == VEHICLE).all()
    assert (found[: len(road)] == ROAD).all() and (found[-len(ramp) :] == ROAD).all()


def test_plants_in_the_air_are_not_what_road_in_the_air_is() -> None:
    road, seat, leaf, car = (sheet(4, *z)[:, [0, 2, 1]] for z in ((0, 4), (1, 1.5), (1.5, 1.7), (1.7, 3)))
    seat[:, 2] = leaf[:, 2] = car[:, 2] = 1.0
    xyz = np.concatenate([road, seat, leaf, car])
    best = np.repeat([ROAD, ROAD, HIGH, VEHICLE], [len(road), len(seat), len(leaf), len(car)]).astype(np.uint8)
    found = without_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(road) :] == VEHICLE).all()


def test_the_foot_of_a_wall_is_the_walls_and_a_kerb_is_not() -> None:
    wall, road = sheet(4, 0, 3), sheet(4, 0, 3, 5.0)[:, [0, 2, 1]]
    kerb = sheet(4, 0, 0.2, 9.0)
    xyz = np.concatenate([wall, road, kerb])
    normal = np.zeros_like(xyz)
    normal[: len(wall), 1] = normal[-len(kerb) :, 1] = normal[len(wall) : -len(kerb), 2] = 1
    best = np.full(len(xyz), ROAD, np.uint8)
    best[: len(wall)][wall[:, 2] > 0.15] = BUILDING
    found = with_feet(best, normal, neighbours(xyz))
    assert (found[: len(wall)] == BUILDING).all() and (found[len(wall) :] == ROAD).all()


def test_vegetation_is_told_by_height_where_it_can_be_nothing_else() -> None:
    xyz = np.concatenate([sheet(1, 0, 0.6), sheet(1, 0, 4, 3.0)])
    found = by_height(np.full(len(xyz), LOW, np.uint8), xyz[:, 2], xyz)
    assert (found[xyz[:, 2] > 2.7] == HIGH).all() and (found[xyz[:, 1] < 1] == LOW).all()
    assert (by_height(np.full(len(xyz), HIGH, np.uint8), xyz[:, 2], xyz)[xyz[:, 1] < 1] == LOW).all()
