"""A scripted drive along a street: the reference path follows the lane, the car follows the path, within its error."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("av", reason="the extra teleop isn't installed")

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.services.teleoperation.control.controls import VehicleState
from scan2sim.services.teleoperation.control.messages import Telemetry
from scan2sim.services.teleoperation.qos import route
from scan2sim.services.teleoperation.qos.route import LoopingVehicle, PurePursuit
from scan2sim.services.teleoperation.qos.scripted_drive import ScriptedCommands
from scan2sim.services.teleoperation.sim.bicycle import Bicycle, Ground
from tests.fakes import synthetic
from tests.fakes.virtual_clock import VirtualClock

STEP = 0.02


def straight() -> F64:
    return np.column_stack([np.arange(0.0, 30.0, route.POINT_SPACING_M), np.zeros(120)])


def telemetry(vehicle: VehicleState) -> Telemetry:
    return Telemetry(vehicle, 1, False, "", -1, 0.0, {})


def test_cross_track_error_is_signed() -> None:
    vehicle = [(0, 3.1, 0.4), (0, 7.77, -0.2), (1, 3.0, 0.0)]
    assert route.cross_track_error(straight(), vehicle) == pytest.approx([0.4, -0.2, 0.0])


@pytest.mark.parametrize("delay", [0, 8])
def test_car_beside_the_path_returns_to_it_even_with_delayed_telemetry(delay: int) -> None:
    one, script, positions = (
        Bicycle(y=1.0),
        ScriptedCommands(lambda vehicle, _: PurePursuit(straight()).steering(vehicle)),
        [],
    )
    states = deque[VehicleState](maxlen=delay + 1)
    for i in range(400):
        states.append(VehicleState(one.speed, (one.x, one.y), one.heading))
        one.step(script.command(telemetry(states[0]), i * STEP).controls, STEP)
        positions.append((0, one.x, one.y))
    error = route.cross_track_error(straight(), positions)
    assert np.abs(error[:10]).min() > 0.9 and np.abs(error[-100:]).max() < 0.1 and one.x > 25


def test_vehicle_without_a_position_is_steered_straight() -> None:
    assert PurePursuit(straight()).steering(VehicleState(1.0)) == 0.0


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A tile that was driven through while recording."""
    return synthetic.driven(tmp_path_factory.mktemp("street"))


def test_car_drives_along_the_reference_path_repeatedly(street: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    ground = Ground(street)
    monkeypatch.setattr(route, "LANE_OFFSET_M", 1.0)
    path = route.reference_path(street, ground)
    assert path[0] == pytest.approx(ground.start[:2]) and len(path) > 10
    clock = VirtualClock(0.0)
    vehicle, script = (
        LoopingVehicle(ground, path, clock=clock),
        ScriptedCommands(lambda vehicle, _: PurePursuit(path).steering(vehicle)),
    )
    while vehicle.runs < 2 and clock() < 60:
        clock.sleep(STEP)
        vehicle.obey(script.command(telemetry(vehicle.state()), clock()).controls)
    assert vehicle.runs == 2 and not vehicle.state().faults
    assert {run for run, _, _ in vehicle.positions} == {0, 1}
    assert np.abs(route.cross_track_error(path, vehicle.positions)).max() < 0.4
    vehicle.begin()
    assert (vehicle.runs, vehicle.positions) == (0, [])
