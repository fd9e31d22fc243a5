"""The driver session: one driver at a time, and commands are sent only while the driver repeats them."""

from __future__ import annotations

import pytest

from scan2sim.pipeline.core.errors import BusyError
from scan2sim.services.teleoperation.control.controls import Controls
from scan2sim.services.teleoperation.control.driver_session import (
    COMMAND_TIMEOUT_S,
    EMERGENCY,
    LOCK_TIMEOUT_S,
    DriverSession,
)
from scan2sim.services.teleoperation.control.messages import Command

AHEAD = Command(Controls(throttle=0.5))


def test_no_command_before_the_lock_is_acquired_and_controls_are_sent() -> None:
    session = DriverSession()
    assert not session.update("a", AHEAD, 0.0) and session.command(0.0) is None
    session.acquire("a", 0.0)
    assert session.command(0.0) is None
    assert session.update("a", AHEAD, 0.0) and session.command(0.1) == AHEAD


def test_command_expires_unless_repeated() -> None:
    session = DriverSession()
    session.acquire("a", 0.0)
    session.update("a", AHEAD, 0.0)
    assert session.command(COMMAND_TIMEOUT_S) == AHEAD and session.command(COMMAND_TIMEOUT_S + 0.01) is None
    session.update("a", AHEAD, 10.0)
    assert session.command(10.0) == AHEAD


def test_only_one_driver_holds_the_lock() -> None:
    session = DriverSession()
    session.acquire("a", 0.0)
    with pytest.raises(BusyError):
        session.acquire("b", 1.0)
    assert not session.update("b", AHEAD, 1.0)
    session.acquire("b", LOCK_TIMEOUT_S + 0.1)
    assert not session.update("a", AHEAD, LOCK_TIMEOUT_S + 0.2), "the silent driver has lost the lock"
    session.release("a", "late")
    assert session.holder() == "b"
    session.release("b", "the page was closed")
    assert (
        session.holder() is None
        and session.release_reason == "the page was closed"
        and session.command(LOCK_TIMEOUT_S + 0.2) is None
    )


def test_session_reports_who_holds_the_lock_and_for_how_long() -> None:
    session = DriverSession()
    assert session.held(5.0) == ("", 0.0)
    session.acquire("anna", 5.0)
    session.update("anna", AHEAD, 7.0)
    session.acquire("anna", 8.0)  # pressed again
    assert session.held(9.0) == ("anna", 4.0)
    session.acquire("ben", 7.0 + LOCK_TIMEOUT_S + 2.0)
    assert session.held(16.0) == ("ben", 2.0)
    session.release("ben", "the page was closed")
    assert session.held(17.0) == ("", 0.0)


def test_emergency_stop_replaces_commands_until_its_driver_ends_it() -> None:
    session = DriverSession()
    session.acquire("page 1", 0.0)
    session.update("page 1", AHEAD, 0.0)
    session.latch("page 2")
    assert session.command(0.0) == session.command(99.0) == EMERGENCY, "also after the driver's page has gone silent"
    session.update("page 1", AHEAD, 0.1)
    assert session.command(0.1) == EMERGENCY
    with pytest.raises(BusyError, match="by the driver only"):
        session.unlatch("page 2")
    session.unlatch("page 1")
    assert session.command(0.1) == AHEAD
    session.latch("page 1")
    session.release("page 1", "left")
    assert session.latched, "leaving does not end it"
    session.unlatch("page 2")
    assert not session.latched, "with no driver any page may end it"
