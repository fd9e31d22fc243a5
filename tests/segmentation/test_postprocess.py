"""Rule-based correction of point classes: specks, feet of walls, heights of vegetation."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.postprocess import correct_vegetation_height, correct_wall_feet, remove_specks

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
def test_floating_vegetation_on_a_wall_becomes_building_but_not_in_the_air(away: float) -> None:
    wall, piece = sheet(6, 0, 6), sheet(3, 2, 5, away)
    xyz = np.concatenate([wall, piece])
    best = np.repeat([BUILDING, HIGH], [len(wall), len(piece)]).astype(np.uint8)
    found = remove_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(wall) :] == (BUILDING if away < 0.5 else HIGH)).all()
    assert (found[: len(wall)] == BUILDING).all()


def test_climbing_plants_rooted_in_the_ground_are_kept() -> None:
    wall, climber = sheet(6, 0, 6), sheet(3, 0, 5, 0.3)
    xyz = np.concatenate([wall, climber])
    best = np.repeat([BUILDING, HIGH], [len(wall), len(climber)]).astype(np.uint8)
    assert (remove_specks(best, xyz[:, 2], xyz, neighbours(xyz)) == best).all()


def test_cloud_of_only_vegetation_is_unchanged() -> None:
    xyz = sheet(2, 1, 2)
    best = np.full(len(xyz), HIGH, np.uint8)
    assert (remove_specks(best, xyz[:, 2], xyz, neighbours(xyz)) == best).all()


def test_floating_road_takes_the_class_around_it_but_a_ramp_stays_road() -> None:
    road, seat, car, ramp = (sheet(4, *z)[:, [0, 2, 1]] for z in ((0, 4), (1, 1.5), (1.5, 2.5), (5, 9)))
    seat[:, 2], car[:, 2], ramp[:, 2] = 1.0, 1.0, 0.3 * (ramp[:, 1] - 5)
    xyz = np.concatenate([road, seat, car, ramp])
    best = np.repeat([ROAD, ROAD, VEHICLE, ROAD], [len(road), len(seat), len(car), len(ramp)]).astype(np.uint8)
    found = remove_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(road) :][: len(seat)] == VEHICLE).all()
    assert (found[: len(road)] == ROAD).all() and (found[-len(ramp) :] == ROAD).all()


def test_floating_vegetation_does_not_become_floating_road() -> None:
    road, seat, leaf, car = (sheet(4, *z)[:, [0, 2, 1]] for z in ((0, 4), (1, 1.5), (1.5, 1.7), (1.7, 3)))
    seat[:, 2] = leaf[:, 2] = car[:, 2] = 1.0
    xyz = np.concatenate([road, seat, leaf, car])
    best = np.repeat([ROAD, ROAD, HIGH, VEHICLE], [len(road), len(seat), len(leaf), len(car)]).astype(np.uint8)
    found = remove_specks(best, xyz[:, 2], xyz, neighbours(xyz))
    assert (found[len(road) :] == VEHICLE).all()


def test_foot_of_a_wall_becomes_building_but_not_a_kerb() -> None:
    wall, road = sheet(4, 0, 3), sheet(4, 0, 3, 5.0)[:, [0, 2, 1]]
    kerb = sheet(4, 0, 0.2, 9.0)
    xyz = np.concatenate([wall, road, kerb])
    normal = np.zeros_like(xyz)
    normal[: len(wall), 1] = normal[-len(kerb) :, 1] = normal[len(wall) : -len(kerb), 2] = 1
    best = np.full(len(xyz), ROAD, np.uint8)
    best[: len(wall)][wall[:, 2] > 0.15] = BUILDING
    found = correct_wall_feet(best, normal, neighbours(xyz))
    assert (found[: len(wall)] == BUILDING).all() and (found[len(wall) :] == ROAD).all()


def test_vegetation_that_contradicts_its_height_is_corrected() -> None:
    xyz = np.concatenate([sheet(1, 0, 0.6), sheet(1, 0, 4, 3.0)])
    found = correct_vegetation_height(np.full(len(xyz), LOW, np.uint8), xyz[:, 2], xyz)
    assert (found[xyz[:, 2] > 2.7] == HIGH).all() and (found[xyz[:, 1] < 1] == LOW).all()
    assert (correct_vegetation_height(np.full(len(xyz), HIGH, np.uint8), xyz[:, 2], xyz)[xyz[:, 1] < 1] == LOW).all()
