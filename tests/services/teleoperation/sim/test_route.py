"""A drive along a street by script: its way lies on the lane, the car follows it, and how far off it was is told."""

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
from scan2sim.services.teleoperation.qos.scripted_drive import Route
from scan2sim.services.teleoperation.sim import route
from scan2sim.services.teleoperation.sim.bicycle import Bicycle, Ground
from scan2sim.services.teleoperation.sim.route import Driven, Pursuit
from tests.pipeline import synthetic

STEP = 0.02


def straight() -> F64:
    return np.column_stack([np.arange(0.0, 30.0, route.SPACING), np.zeros(120)])


def told(vehicle: VehicleState) -> Telemetry:
    return Telemetry(vehicle, 1, False, "", -1, 0.0, {})


def test_how_far_aside_is_told_with_the_side() -> None:
    driven = [(0, 3.1, 0.4), (0, 7.77, -0.2), (1, 3.0, 0.0)]
    assert route.aside(straight(), driven) == pytest.approx([0.4, -0.2, 0.0])


@pytest.mark.parametrize("late", [0, 8])
def test_a_car_that_begins_beside_the_way_comes_back_to_it_though_telemetry_is_late(late: int) -> None:
    one, script, places = Bicycle(y=1.0), Route(lambda vehicle, _: Pursuit(straight()).steering(vehicle)), []
    seen = deque[VehicleState](maxlen=late + 1)
    for i in range(400):
        seen.append(VehicleState(one.speed, (one.x, one.y), one.heading))
        one.step(script.command(told(seen[0]), i * STEP).controls, STEP)
        places.append((0, one.x, one.y))
    off = route.aside(straight(), places)
    assert np.abs(off[:10]).min() > 0.9 and np.abs(off[-100:]).max() < 0.1 and one.x > 25


def test_a_vehicle_that_does_not_tell_where_it_is_is_driven_straight_on() -> None:
    assert Pursuit(straight()).steering(VehicleState(1.0)) == 0.0


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A tile that was driven through."""
    return synthetic.driven(tmp_path_factory.mktemp("street"))


def test_a_car_is_driven_along_a_world_s_way_again_and_again(street: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    ground = Ground(street)
    monkeypatch.setattr(route, "SWAY", 1.0)
    way = route.way(street, ground)
    assert way[0] == pytest.approx(ground.start[:2]) and len(way) > 10
    now = [0.0]
    monkeypatch.setattr("scan2sim.services.teleoperation.vehicle.adapters.simulated.time.monotonic", lambda: now[0])
    driven, script = Driven(ground, way), Route(lambda vehicle, _: Pursuit(way).steering(vehicle))
    while driven.runs < 2 and now[0] < 60:
        now[0] += STEP
        driven.obey(script.command(told(driven.state()), now[0]).controls)
    assert driven.runs == 2 and not driven.state().faults
    assert {run for run, _, _ in driven.places} == {0, 1}
    assert np.abs(route.aside(way, driven.places)).max() < 0.4
    driven.begin()
    assert (driven.runs, driven.places) == (0, [])
