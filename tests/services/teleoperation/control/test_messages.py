import math
import os
from typing import Any

import pytest

from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import (
    Command,
    KeyFrameRequest,
    Kind,
    Malformed,
    Message,
    Telemetry,
    VideoKey,
    VideoReport,
    VideoStream,
    VideoStreams,
)

STATE = VehicleState(1.5, (2.0, -3.0), 0.5, Gear.FORWARD, ("a tyre is flat",))
BODIES = [
    Command(Controls(-0.5, 0.25, 1.0, Gear.REVERSE, horn=True, lights=True), stop=7, agree=True),
    Command(Controls(brake=1.0), emergency=True),
    VideoKey(3, bytes(range(44))),
    KeyFrameRequest(2),
    Telemetry(STATE, 4, True, "both links", 12, 31.5, {"old": 3}, 12.5),
    VideoReport(1, 100, 2, 41.0, {"lte": 1e6, "wifi": 2e6}),
    VideoStreams((VideoStream(0, "front", 640, 480, 30.0),)),
]


@pytest.mark.parametrize("sent", BODIES, ids=lambda one: type(one).__name__)
def test_body_survives_encoding(sent: Any) -> None:
    assert type(sent).unpack(sent.pack()) == sent


@pytest.mark.parametrize("sent", BODIES, ids=lambda one: type(one).__name__)
def test_invalid_body_is_malformed(sent: Any) -> None:
    body = sent.pack()
    for wrong in (b"", body[:-1], body + b"x", os.urandom(len(body) + 1)):
        with pytest.raises(Malformed):
            type(sent).unpack(wrong)


@pytest.mark.parametrize("steering, throttle", [(1.01, 0.0), (math.nan, 0.0), (0.0, -0.1), (0.0, math.inf)])
def test_controls_out_of_range_are_malformed(steering: float, throttle: float) -> None:
    with pytest.raises(Malformed):
        Command.unpack(Command(Controls(steering, throttle)).pack())


def test_message_keeps_its_header() -> None:
    message = Message(Kind.COMMAND, 2**40, 123456789012345, b"body")
    assert Message.unpack(message.pack()) == message
    for wrong in (b"", b"\x63" + message.pack()[1:], message.pack()[:10]):
        with pytest.raises(Malformed):
            Message.unpack(wrong)
