"""The wheel: one driver, and nothing is sent on that he doesn't go on asking for."""

from __future__ import annotations

import pytest

from scan2sim.pipeline.core.errors import BusyError
from scan2sim.services.teleoperation.control.controls import Controls
from scan2sim.services.teleoperation.control.driver_session import FRESH, HELD, Wheel
from scan2sim.services.teleoperation.control.messages import Command

AHEAD = Command(Controls(throttle=0.5))


def test_nothing_is_asked_before_the_wheel_is_taken_and_turned() -> None:
    wheel = Wheel()
    assert not wheel.turn("a", AHEAD, 0.0) and wheel.command(0.0) is None
    wheel.take("a", 0.0)
    assert wheel.command(0.0) is None
    assert wheel.turn("a", AHEAD, 0.0) and wheel.command(0.1) == AHEAD


def test_what_is_not_asked_again_is_not_sent_on() -> None:
    wheel = Wheel()
    wheel.take("a", 0.0)
    wheel.turn("a", AHEAD, 0.0)
    assert wheel.command(FRESH) == AHEAD and wheel.command(FRESH + 0.01) is None
    wheel.turn("a", AHEAD, 10.0)
    assert wheel.command(10.0) == AHEAD


def test_one_drives() -> None:
    wheel = Wheel()
    wheel.take("a", 0.0)
    with pytest.raises(BusyError):
        wheel.take("b", 1.0)
    assert not wheel.turn("b", AHEAD, 1.0)
    wheel.take("b", HELD + 0.1)
    assert not wheel.turn("a", AHEAD, HELD + 0.2), "who fell silent has lost it"
    wheel.leave("a", "late")
    assert wheel.held_by() == "b"
    wheel.leave("b", "the page was closed")
    assert wheel.held_by() is None and wheel.told == "the page was closed" and wheel.command(HELD + 0.2) is None
