"""What a scripted drive is measured by, and a short one on this machine."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("av", reason="the extra teleop isn't installed")
pytest.importorskip("psutil", reason="the extra measuring isn't installed")

from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import passed, rows
from scan2sim.services.qos.requirements import NETWORK, Environment
from scan2sim.services.teleoperation.control.controls import Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Kind, Telemetry
from scan2sim.services.teleoperation.qos.measure import (
    delays,
    film,
    gap,
    jitter,
    measure,
    missing,
    percentile,
    planned,
    quiet,
    responses,
)
from scan2sim.services.teleoperation.qos.scripted_drive import SEEN, SPEED, Route
from scan2sim.services.teleoperation.settings import MeasureParams

MS = 10**6
SERVICE = requirements.read("teleoperation")


def command(number: int, sent: int, came: int) -> tuple[int, int, int, int]:
    return Kind.COMMAND, number, sent * MS, came * MS


def test_messages_that_overtook_each_other_are_told_in_the_order_of_their_sending() -> None:
    heard = [command(0, 0, 30), command(2, 40, 65), command(1, 20, 70), (Kind.REPORT, 3, 50 * MS, 90 * MS)]
    assert delays(heard, Kind.COMMAND) == [30, 50, 25]
    assert jitter([30, 50, 25]) == pytest.approx(22.5)
    assert gap(heard, Kind.COMMAND) == 35
    assert missing(heard) == 0 and missing([heard[0], heard[3]]) == 2


def test_what_never_came_is_late() -> None:
    assert gap([], Kind.COMMAND) == math.inf == percentile([], 95)
    assert missing([]) == 0


def test_a_command_is_answered_by_the_first_telemetry_that_tells_of_it_or_of_a_later_one() -> None:
    heard = [command(0, 0, 20), command(1, 20, 40), command(2, 40, 60), command(3, 60, 80)]
    assert list(responses(heard, [(-1, 5 * MS), (1, 70 * MS), (2, 90 * MS)])) == [70, 50, 50]  # of the last, nothing is


def test_video_has_the_bits_that_are_asked_and_takes_links_in_turn_where_none_carries_all() -> None:
    params = MeasureParams(environment=Environment.CLOUD)
    cloud = planned(params, SERVICE.of(Environment.CLOUD), 20e6)
    assert cloud.share and 4 * cloud.bitrate > 20e6
    assert not planned(params, SERVICE.of(Environment.EDGE), 100e6).share
    assert not planned(params.model_copy(update={"bitrate": 1.0}), SERVICE.of(Environment.CLOUD), 20e6).share
    assert not planned(params, SERVICE.of(Environment.ROBOT), None).share


def test_the_script_confirms_a_stop_once_it_has_seen_it_then_drives() -> None:
    route = Route()

    def told(stop: int, standing: bool, speed: float = 0.0) -> Telemetry:
        return Telemetry(VehicleState(speed), stop, standing, "", -1, 0.0, {})

    first = route.command(told(7, True), 1.0)
    assert first.stop == 7 and not first.agree and first.controls.at_rest()
    assert route.command(told(7, True), 1.01 + SEEN).agree
    drives = route.command(told(7, False), 2.0).controls
    assert drives.throttle > 0 and drives.gear == Gear.FORWARD
    assert route.command(told(7, False, SPEED + 2), 2.0).controls.brake > 0
    assert not route.command(told(8, True), 3.0).agree


def test_cameras_see_pictures_of_the_street(tmp_path: Path) -> None:
    import cv2

    pictures = [cv2.imread(str(one)) for one in sorted(film(tmp_path / "film").iterdir())[:2]]
    one, other = pictures
    assert one is not None and other is not None
    assert one.shape == (480, 640, 3) and (one != other).mean() > 0.5


def test_a_drive_on_this_machine_is_measured_against_what_the_robot_needs() -> None:
    params = MeasureParams(environment=Environment.ROBOT, seconds=2, warm=0, cameras=1)
    required = SERVICE.of(Environment.ROBOT)
    measured = measure(params, required, quiet)
    values = measured.values()
    assert values["bandwidth"] is None and passed(rows(required, measured), NETWORK)
    assert len(delays(measured.vehicle["messages"], Kind.COMMAND)) > 50 and measured.command_gap < 1000
    assert len(measured.glass_to_glass) > 20 and min(measured.glass_to_glass) > 0
    assert values["loss_rate"] == 0 and values["error_rate"] == 0 and 0 < measured.lost_frames + 1 < 1.2
