"""A complete drive: gateway, station, vehicle and adapter, with failures on the way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.services.teleoperation.control.controls import Controls
from tests.services.teleoperation.street import AHEAD, REST, Street
from tests.waiting import until

pytestmark = pytest.mark.realtime


@pytest.fixture
def street(tmp_path: Path) -> Iterator[Street]:
    street = Street(tmp_path)
    yield street
    street.close()


def stopped(controls: Controls) -> bool:
    return controls.throttle == 0 and controls.brake == 1


def wait_for_commands(street: Street, count: int = 20) -> None:
    """Wait until the vehicle has received further commands of the joined station."""
    safety = street.vehicle._unit.car.safety
    for _ in range(count):
        last = safety._newest
        until(lambda: safety._newest != last)  # noqa: B023


def controls_since(street: Street, first: int) -> list[Controls]:
    """All controls that the vehicle has received, from this one on."""
    return [controls for _, controls in street.car.received[first:]]


def test_driver_sees_video_confirms_and_drives(street: Street) -> None:
    desk = street.desk()
    assert stopped(street.car.controls) or street.car.controls == Controls()
    street.fleet.join("car", "desk", "operator")
    until(lambda: len(desk.frames) > 10)
    assert desk.frames[0].key and (desk.frames[0].width, desk.frames[0].height) == (160, 120)
    desk.drive(AHEAD)
    wait_for_commands(street)
    assert desk.standing() and all(map(stopped, controls_since(street, 0))), "nobody has confirmed"
    desk.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
    until(lambda: any(link["up"] for link in street.fleet.snapshot()["vehicles"][0]["links"]))
    desk.drive(None)
    until(lambda: stopped(street.car.controls))
    count = len(street.car.received)
    desk.drive(AHEAD)
    wait_for_commands(street)
    confirm = "it stopped by itself, and starts only after a confirmation"
    assert all(map(stopped, controls_since(street, count))), confirm
    desk.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
    street.fleet.release("car", "operator")
    until(lambda: stopped(street.car.controls))


def test_packets_lost_on_both_links_are_retransmitted(street: Street) -> None:
    desk = street.desk(relayed=True)
    street.fleet.join("car", "desk", "operator")
    until(lambda: desk.frames)
    desk.shape.loss = 0.4

    def frames() -> Counter[str]:
        joined = desk.station.joined()
        assert joined is not None
        return joined.receiver.frames()[0]

    until(lambda: frames()["retransmitted"] >= 4)


def test_camera_that_changes_its_frame_size_does_not_interrupt_the_drive(street: Street) -> None:
    desk = street.desk()
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: desk.frames)
    stop = desk.stop()
    for size in ((320, 240), (100, 76)):
        street.size = size
        until(lambda: (desk.frames[-1].width, desk.frames[-1].height) == size)  # noqa: B023
        assert next(frame for frame in desk.frames if (frame.width, frame.height) == size).key
        until(lambda: [(one.width, one.height) for one in desk.streams()] == [size])  # noqa: B023
    count = len(desk.frames)
    until(lambda: len(desk.frames) > count + 5)
    assert desk.stop() == stop and street.car.controls.throttle == AHEAD.throttle


def test_pair_keeps_driving_while_its_gateway_restarts(street: Street) -> None:
    desk = street.desk()
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
    stop = desk.stop()
    count = len(street.car.received)
    street.restart_gateway()

    def is_known() -> bool:
        fleet = street.fleet.snapshot()
        there = [one["connected"] for kind in fleet.values() for one in kind]
        return there == [True, True] and fleet["vehicles"][0]["other"] == "desk"

    until(is_known)
    wait_for_commands(street)
    assert desk.stop() == stop and {one.throttle for one in controls_since(street, count)} == {AHEAD.throttle}


def test_handover_ends_the_first_drive_and_requires_a_confirmation(street: Street) -> None:
    desk, other = street.desk(), street.desk("other")
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
    street.fleet.hand_over("car", "other", "operator")
    until(lambda: stopped(street.car.controls))
    until(lambda: other.telemetry() is not None)
    count = len(street.car.received)
    desk.drive(AHEAD)
    other.drive(AHEAD)
    wait_for_commands(street)
    assert all(map(stopped, controls_since(street, count))) and desk.station.joined() is None
    other.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)


def test_restarted_station_gets_its_vehicle_back(street: Street) -> None:
    desk = street.desk()
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
    port = desk.port
    street.desks.remove(desk)
    desk.close()
    until(lambda: stopped(street.car.controls))
    again = street.desk(port=port)
    again.drive(REST)
    until(lambda: again.telemetry() is not None)
    assert stopped(street.car.controls)
    again.start()
    until(lambda: street.car.controls.throttle == AHEAD.throttle)
