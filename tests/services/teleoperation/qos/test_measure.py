"""Metrics of a scripted drive, and a short drive on this machine."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("av", reason="the extra teleop isn't installed")
pytest.importorskip("psutil", reason="the extra measuring isn't installed")

from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import compare_metrics, passed
from scan2sim.services.qos.requirements import NETWORK_METRICS, Environment
from scan2sim.services.teleoperation.control.controls import Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Kind, Telemetry
from scan2sim.services.teleoperation.qos.measure import (
    count_missing,
    delays,
    ignore_progress,
    jitter,
    longest_gap,
    measure,
    percentile,
    plan_setup,
    render_test_images,
    response_times,
)
from scan2sim.services.teleoperation.qos.scripted_drive import CONFIRM_DELAY_S, TARGET_SPEED_MPS, ScriptedCommands
from scan2sim.services.teleoperation.settings import MeasureParams

MS = 10**6
SERVICE = requirements.read("teleoperation")


def command(number: int, sent: int, received: int) -> tuple[int, int, int, int]:
    return Kind.COMMAND, number, sent * MS, received * MS


def test_reordered_messages_are_evaluated_in_sending_order() -> None:
    received = [command(0, 0, 30), command(2, 40, 65), command(1, 20, 70), (Kind.VIDEO_REPORT, 3, 50 * MS, 90 * MS)]
    assert delays(received, Kind.COMMAND) == [30, 50, 25]
    assert jitter([30, 50, 25]) == pytest.approx(22.5)
    assert longest_gap(received, Kind.COMMAND) == 35
    assert count_missing(received) == 0 and count_missing([received[0], received[3]]) == 2


def test_missing_messages_are_infinitely_late() -> None:
    assert longest_gap([], Kind.COMMAND) == math.inf == percentile([], 95)
    assert count_missing([]) == 0


def test_response_time_ends_with_the_first_telemetry_that_reports_the_command_or_a_later_one() -> None:
    received = [command(0, 0, 20), command(1, 20, 40), command(2, 40, 60), command(3, 60, 80)]
    # the last command is never reported
    assert list(response_times(received, [(-1, 5 * MS), (1, 70 * MS), (2, 90 * MS)])) == [70, 50, 50]


def test_video_gets_the_required_bit_rate_and_shares_links_that_can_not_carry_all() -> None:
    params = MeasureParams(environment=Environment.CLOUD)
    cloud = plan_setup(params, SERVICE.of(Environment.CLOUD), 20e6)
    assert cloud.share and 4 * cloud.bitrate > 20e6
    assert not plan_setup(params, SERVICE.of(Environment.EDGE), 100e6).share
    assert not plan_setup(params.model_copy(update={"bitrate": 1.0}), SERVICE.of(Environment.CLOUD), 20e6).share
    assert not plan_setup(params, SERVICE.of(Environment.ROBOT), None).share


def test_scripted_driver_confirms_a_stop_after_a_delay_then_drives() -> None:
    script = ScriptedCommands()

    def telemetry(stop: int, standing: bool, speed: float = 0.0) -> Telemetry:
        return Telemetry(VehicleState(speed), stop, standing, "", -1, 0.0, {})

    first = script.command(telemetry(7, True), 1.0)
    assert first.stop == 7 and not first.agree and first.controls.throttle_released()
    assert script.command(telemetry(7, True), 1.01 + CONFIRM_DELAY_S).agree
    drives = script.command(telemetry(7, False), 2.0).controls
    assert drives.throttle > 0 and drives.gear == Gear.FORWARD
    assert script.command(telemetry(7, False, TARGET_SPEED_MPS + 2), 2.0).controls.brake > 0
    assert not script.command(telemetry(8, True), 3.0).agree


def test_test_images_show_the_street(tmp_path: Path) -> None:
    import cv2

    images = [cv2.imread(str(one)) for one in sorted(render_test_images(tmp_path / "images").iterdir())[:2]]
    one, other = images
    assert one is not None and other is not None
    assert one.shape == (480, 640, 3) and (one != other).mean() > 0.5


@pytest.mark.realtime
def test_drive_on_this_machine_meets_the_requirements_of_the_robot() -> None:
    params = MeasureParams(environment=Environment.ROBOT, seconds=4, warm=0, cameras=1, bitrate=0.5)
    required = SERVICE.of(Environment.ROBOT)
    measured = measure(params, required, ignore_progress)
    values = measured.values()
    assert values["bandwidth"] is None and passed(compare_metrics(required, measured), NETWORK_METRICS)
    assert len(delays(measured.vehicle["messages"], Kind.COMMAND)) > 50
    assert measured.command_gap < 1000 * measured.seconds
    assert len(measured.glass_to_glass) > 20 and min(measured.glass_to_glass) > 0
    assert values["loss_rate"] == 0 and values["error_rate"] == 0 and 0 < measured.lost_frames + 1 < 1.2
