"""What the commands say about wrong input, and how they end: once, in the user's own words, without a traceback."""

from __future__ import annotations

import signal

import pytest

from tests.fakes.nodes import end, wait_until_ready
from tests.fakes.ports import free_dds_domain
from tests.services.conftest import Start

CLI = ("cyclone", "-m", "scan2sim.flows.cli", "monitor")


@pytest.mark.parametrize(
    ("arguments", "code", "cause"),
    [
        (("talker", "/chatter", "--kafka", "a b"), 2, "--kafka: must be HOST:PORT"),
        (("topic", "a b"), 2, "TOPIC...: must be"),
        (("talker", "/chatter", "--to", "a b"), 2, "--to: must be"),
        (("work", "/cars", "/no/such/worker --fast"), 2, "WORKER: there is no program '/no/such/worker --fast'"),
        (("topic", "/nothing", "--timeout", "1"), 4, "/nothing: no publisher within 1 s"),
    ],
)
def test_wrong_input_is_named_once(arguments: tuple[str, ...], code: int, cause: str, start: Start) -> None:
    process = start(*CLI, *arguments, ROS_DOMAIN_ID=str(free_dds_domain()))
    _, errors = end(process)
    assert process.returncode == code
    assert errors.startswith(f"error: {cause}") and errors.count("error:") == 1 and "Traceback" not in errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_node_ends_silently(number: signal.Signals, start: Start) -> None:
    process = start(*CLI, "talker", "/chatter", ROS_DOMAIN_ID=str(free_dds_domain()))
    wait_until_ready(process)
    process.send_signal(number)
    _, errors = end(process)
    assert process.returncode == 0 and "kept" not in errors and "Traceback" not in errors
