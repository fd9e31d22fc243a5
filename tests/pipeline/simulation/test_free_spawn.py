"""Spawn poses: the supplied robot, placed at one, touches nothing."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.data_samples.building import Style, build
from scan2sim.pipeline.core.types import Bools, Mesh
from scan2sim.pipeline.geometry.surface_distance import sample_surface
from scan2sim.pipeline.simulation.free_spawn import CLEARANCE_M, spawn_pose
from scan2sim.pipeline.simulation.occupancy import Band, storeys
from scan2sim.pipeline.simulation.robot import ROBOT, Start
from tests.fakes.boxes import box, joined

STEP_M = 0.1
"""Height of what the robot drives over."""


def touching(mesh: Mesh, start: Start) -> Bools:
    """Which of random points of a mesh are inside the box around the robot, above what it drives over."""
    points = sample_surface(mesh, 500_000).astype(np.float64)
    own = (points - start.position) @ Rotation.from_euler("xyz", start.angles).as_matrix()
    low, high = map(np.array, ROBOT.extent)
    low[2] = STEP_M
    return np.asarray(((own > low) & (own < high)).all(axis=1))


@pytest.mark.parametrize("seed", range(3))
def test_spawn_pose_has_clearance_near_the_start(seed: int) -> None:
    building = build(seed, Style(rooms=3))
    begin = building.routes[0][0]
    (storey,) = storeys(building.mesh, building.routes[0] + (0, 0, 0.5))
    start, clearance, fits, turns = spawn_pose(storey, begin)
    truth = building.free_space(0, low=Band.low, high=Band.high, clearance=CLEARANCE_M - 0.1)
    assert clearance >= CLEARANCE_M and truth.at([start.position[:2]]).all()
    assert fits and turns and not touching(building.mesh, start).any()
    assert np.linalg.norm(np.array(start.position[:2]) - begin[:2]) < 1.5
    assert start.position[2] == pytest.approx(building.floors[0] + 0.02, abs=0.01)
    ahead = start.position[0] + np.cos(start.angles[2]), start.position[1] + np.sin(start.angles[2])
    assert building.free_space(0, low=Band.low, high=Band.high).at([ahead]).all()


def corridor(width: float, angle: float) -> tuple[Mesh, Rotation]:
    """A dead end of this width from x = 0 to 4 m with a bar 70 cm above its floor, turned about z."""
    floor = box((-0.2, -1.5, -0.1), (4.2, 1.5, 0))
    walls = [box((0, y, 0), (4, y + 0.2, 2)) for y in (-width / 2 - 0.2, width / 2)]
    ends = [box((x, -1, 0), (x + 0.2, 1, 2)) for x in (-0.2, 4.0)]
    mesh = joined(floor, *walls, *ends, box((2, -1, 0.7), (2.2, 1, 0.72)))
    R = Rotation.from_euler("z", angle)
    return Mesh(mesh.frame, R.apply(mesh.vertices).astype(np.float32), mesh.faces), R


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0, -2.5])
def test_robot_fits_where_there_is_no_room_to_turn(angle: float) -> None:
    mesh, R = corridor(0.85, angle)
    (storey, *_) = storeys(mesh, R.apply([[0.1, 0.0, 0.5]]))
    found = spawn_pose(storey, R.apply([0.1, 0.0, 0.5]))
    assert found.fits and not found.turns and found.clearance < CLEARANCE_M
    assert not touching(mesh, found.start).any()
    x, y, _ = R.inv().apply(found.start.position)
    assert x < 1.9 and abs(y) < 0.2  # on this side of the bar


def test_places_that_are_too_narrow_for_the_robot_are_reported() -> None:
    mesh, _ = corridor(0.55, 0.0)
    (storey, *_) = storeys(mesh, np.array([[1.0, 0.0, 0.5]]), Band(radius=0.2))
    found = spawn_pose(storey, np.array([1.0, 0.0, 0.5]))
    assert not found.fits and not found.turns and touching(mesh, found.start).any()


def test_documented_footprint_covers_the_robot() -> None:
    text = (Path(__file__).parents[3] / "docs" / "robot-map.md").read_text(encoding="utf-8")
    (found,) = re.findall(r'footprint: "(.*?)"', text)
    corners, (low, high) = np.array(ast.literal_eval(found)), np.array(ROBOT.extent)[:, :2]
    assert (corners.min(axis=0) <= low).all() and (corners.max(axis=0) >= high).all()
    assert np.abs(np.abs(corners).max(axis=0) - np.maximum(-low, high)).max() < 0.02
