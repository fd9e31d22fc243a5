"""The simulated car follows the bicycle model, stays on the ground, and stops at walls."""

from __future__ import annotations

from math import pi, tan
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.sim.bicycle import STEP_MAX_S, Bicycle, Car, Ground, PoseTracker, SimulatedCar
from tests.fakes import synthetic

GO = Controls(throttle=1.0, gear=Gear.FORWARD)


def drive(bicycle: Bicycle, controls: Controls, seconds: float) -> None:
    for _ in range(round(seconds / STEP_MAX_S)):
        bicycle.step(controls, STEP_MAX_S)


def test_drives_a_circle_of_the_radius_of_its_steering_angle() -> None:
    one = Bicycle()
    drive(one, Controls(steering=1.0), 2.0)
    assert (one.x, one.y) == (0.0, 0.0) and one.steering == pytest.approx(Car.steering)
    one.speed, one.gear = 2.0, Gear.FORWARD
    radius = Car.wheelbase / tan(Car.steering)
    points = []
    hold = Controls(steering=1.0, throttle=1e-9, gear=Gear.FORWARD)
    for _ in range(round(pi * radius / 2.0 / STEP_MAX_S)):
        one.step(hold, STEP_MAX_S)
        points.append((one.x, one.y))
    assert np.hypot(*(np.array(points) - (0.0, radius)).T) == pytest.approx(radius, abs=0.01)
    assert one.heading == pytest.approx(pi, abs=0.02)


def test_speed_and_steering_change_within_limits_and_brakes_do_not_reverse() -> None:
    one, car = Bicycle(), Car()
    drive(one, GO, 2.0)
    assert one.speed == pytest.approx(2 * car.acceleration)
    drive(one, GO, 20.0)
    assert one.speed == car.max_speed
    start = one.x
    drive(one, STOP, 4.0)
    assert one.speed == 0.0
    assert one.x - start == pytest.approx(car.max_speed**2 / 2 / (car.braking + car.rolling), rel=0.02)
    drive(one, Controls(throttle=1.0, gear=Gear.REVERSE), 5.0)
    assert one.speed == -car.max_reverse_speed
    drive(one, Controls(gear=Gear.NEUTRAL, throttle=1.0), 100.0)
    assert one.speed == 0.0


def test_reverse_gear_is_not_engaged_at_speed() -> None:
    one = Bicycle()
    drive(one, GO, 2.0)
    drive(one, Controls(throttle=1.0, gear=Gear.REVERSE), 1.0)
    assert 0 < one.speed < 5.0
    drive(one, STOP, 1.0)
    drive(one, Controls(throttle=1.0, gear=Gear.REVERSE), 1.0)
    assert one.gear == Gear.REVERSE and one.speed < -1


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A tile with a house at (4..7, 2..4), and a driven path south of it."""
    return synthetic.driven(tmp_path_factory.mktemp("street"))


@pytest.fixture
def car(street: Scene) -> SimulatedCar:
    return SimulatedCar(Ground(street))


def test_starts_on_the_road_and_follows_the_ground(car: SimulatedCar) -> None:
    assert car.state().position == pytest.approx((-6.0, -2.0), abs=0.6)
    assert car.state().heading == pytest.approx(0.0, abs=0.05)
    for _ in range(20):
        car.advance(Controls(throttle=0.5, gear=Gear.FORWARD), 0.1)
        middle = car.pose @ (Car.wheelbase / 2, 0.0, 0.0, 1.0)
        assert middle[2] == pytest.approx(synthetic.height(middle[0], middle[1]), abs=0.12)
        assert car.pose[:3, :3] @ car.pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(car.pose[:3, :3]) == pytest.approx(1.0) and car.pose[2, 2] > 0.9
    speed = car.state().speed
    assert speed is not None and speed > 2 and not car.fault


def test_pose_tracker_follows_the_reported_state(street: Scene, car: SimulatedCar) -> None:
    tracker = PoseTracker(Ground(street))
    for _ in range(10):
        car.advance(Controls(0.2, 0.5, 0.0, Gear.FORWARD), 0.1)
        assert tracker(car.state()) == pytest.approx(car.pose, abs=1e-5)
    assert tracker(VehicleState()) == pytest.approx(car.pose, abs=1e-5)


def test_stops_at_a_wall_and_drives_away_again(car: SimulatedCar) -> None:
    car.bicycle.x, car.bicycle.y, car.bicycle.heading = -2.0, 3.0, 0.0  # the wall is at x = 4
    car.advance(GO, 5.0)
    state = car.state()
    assert state.speed == 0.0 and state.faults == ("collision with an obstacle",)
    assert state.position is not None and 4.0 - Car.wheelbase - Car.front - 0.3 < state.position[0] < 4.0
    assert state.position[0] + Car.wheelbase + Car.front == pytest.approx(4.0, abs=0.1)
    car.advance(Controls(throttle=1.0, gear=Gear.REVERSE), 1.0)
    speed = car.state().speed
    assert speed is not None and speed < -1 and not car.state().faults


def test_stops_at_the_end_of_the_ground(car: SimulatedCar) -> None:
    car.advance(GO, 20.0)
    state = car.state()
    assert state.speed == 0.0 and state.faults == ("end of the drivable ground",)
    assert state.position is not None and state.position[0] + Car.wheelbase == pytest.approx(10.0, abs=0.6)


def test_world_without_a_road_is_reported(tmp_path: Path) -> None:
    from scan2sim.pipeline.core.errors import DataError

    with pytest.raises(DataError, match="no spawn pose"):
        Ground(synthetic.scene(tmp_path, tiles=1))
