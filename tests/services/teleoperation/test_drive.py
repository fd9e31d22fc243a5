"""A drive from afar, whole: gateway, station, vehicle and translator, with what goes wrong on the way."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.services.teleoperation.control.controls import Controls
from tests.services.teleoperation.street import AHEAD, REST, Street, until


@pytest.fixture
def street(tmp_path: Path) -> Iterator[Street]:
    made = Street(tmp_path)
    yield made
    made.close()


def stands(controls: Controls) -> bool:
    return controls.throttle == 0 and controls.brake == 1


def test_a_driver_sees_what_the_vehicle_sees_confirms_and_drives(street: Street) -> None:
    desk = street.desk()
    assert stands(street.wheels.controls) or street.wheels.controls == Controls()
    street.fleet.join("car", "desk", "operator")
    until(lambda: len(desk.frames) > 10)
    assert desk.frames[0].key and (desk.frames[0].width, desk.frames[0].height) == (160, 120)
    desk.drive(AHEAD)
    time.sleep(1.0)
    assert desk.standing() and street.wheels.controls.throttle == 0, "nobody has confirmed"
    desk.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
    until(lambda: any(link["up"] for link in street.fleet.facts()["vehicles"][0]["links"]))
    desk.drive(None)
    until(lambda: stands(street.wheels.controls))
    desk.drive(AHEAD)
    time.sleep(1.0)
    assert stands(street.wheels.controls), "it stopped by itself, and starts by nothing but a confirmation"
    desk.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
    street.fleet.release("car", "operator")
    until(lambda: stands(street.wheels.controls))


def test_pictures_that_both_links_lose_are_sent_again(street: Street) -> None:
    desk = street.desk(loss=0.2)
    street.fleet.join("car", "desk", "operator")
    until(lambda: desk.frames)

    def frames() -> Counter[str]:
        joined = desk.station.joined()
        assert joined is not None
        return joined.watcher.frames()[0]

    until(lambda: frames()["mended"] >= 4)


def test_a_camera_that_changes_its_size_is_seen_on_and_nobody_stops(street: Street) -> None:
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
    assert desk.stop() == stop and street.wheels.controls.throttle == AHEAD.throttle


def test_a_pair_drives_on_while_its_gateway_starts_anew(street: Street) -> None:
    desk = street.desk()
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
    stop = desk.stop()
    street.restart_gateway()
    until(lambda: [one["there"] for kind in street.fleet.facts().values() for one in kind] == [True, True])
    assert desk.stop() == stop and street.wheels.controls.throttle == AHEAD.throttle
    assert street.fleet.facts()["vehicles"][0]["other"] == "desk"


def test_who_has_handed_over_drives_no_more_and_who_takes_over_confirms(street: Street) -> None:
    desk, other = street.desk(), street.desk("other")
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
    street.fleet.hand_over("car", "other", "operator")
    until(lambda: stands(street.wheels.controls))
    until(lambda: other.telemetry() is not None)
    desk.drive(AHEAD)
    other.drive(AHEAD)
    time.sleep(1.0)
    assert stands(street.wheels.controls) and desk.station.joined() is None
    other.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)


def test_a_station_that_starts_anew_gets_its_vehicle_back(street: Street) -> None:
    desk = street.desk()
    street.fleet.join("car", "desk", "operator")
    desk.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
    port = desk.port
    street.desks.remove(desk)
    desk.close()
    until(lambda: stands(street.wheels.controls))
    again = street.desk(port=port)
    again.drive(REST)
    until(lambda: again.telemetry() is not None)
    assert stands(street.wheels.controls)
    again.start()
    until(lambda: street.wheels.controls.throttle == AHEAD.throttle)
