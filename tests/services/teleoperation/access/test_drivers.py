"""Named drivers: tokens, roles, revocation that takes effect at once, and who did what in the gateway's audit trail."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")
from typer.testing import CliRunner
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access import drivers
from scan2sim.services.teleoperation.access.drivers import DriverRole, Drivers
from scan2sim.services.teleoperation.settings import StationParams
from tests.services.teleoperation.pages import Cockpit, served
from tests.waiting import until


def test_token_identifies_its_driver_until_it_is_replaced_revoked_or_expires(tmp_path: Path) -> None:
    file = tmp_path / "drivers.json"
    old = drivers.add(file, "anna", DriverRole.DRIVER)
    known = Drivers(file)
    anna = known.identify(old)
    assert anna is not None and (anna.name, anna.role) == ("anna", DriverRole.DRIVER)
    assert known.identify("x" * 64) is None and known.identify("") is None
    assert old not in file.read_text(encoding="utf-8") and file.stat().st_mode & 0o077 == 0
    new = drivers.add(file, "anna", DriverRole.OBSERVER)
    assert known.identify(old) is None and known.identify(new) is not None
    expired = drivers.add(file, "ben", DriverRole.DRIVER, datetime.now(UTC) - timedelta(seconds=1))
    assert known.identify(expired) is None
    drivers.revoke(file, "anna")
    assert known.identify(new) is None
    with pytest.raises(SettingError, match="no driver 'anna'"):
        drivers.revoke(file, "anna")


def test_damaged_file_lets_nobody_in(tmp_path: Path) -> None:
    file = tmp_path / "drivers.json"
    token = drivers.add(file, "anna", DriverRole.DRIVER)
    known = Drivers(file)
    for damage in ("[", '[{"name": "anna"}]', ""):
        file.write_text(damage, encoding="utf-8")
        assert known.identify(token) is None
        with pytest.raises(InputError, match="teleop drivers"):
            Drivers(file)
    file.unlink()
    assert known.identify(token) is None


def test_drivers_protect_a_page_that_others_can_reach(tmp_path: Path) -> None:
    given: dict[str, Any] = {"certificates": tmp_path, "gateway": "gate.example", "host": "0.0.0.0"}
    with pytest.raises(SettingError):
        StationParams(**given)
    assert not StationParams(**given, drivers=tmp_path / "drivers.json").is_open()


def page(cockpit: Cockpit, token: str) -> ClientConnection:
    """The WebSocket of a driver's page."""
    named = ["scan2sim", f"token.{token.encode().hex()}"]
    return connect(cockpit.url.replace("http", "ws") + "live", subprotocols=named)  # type: ignore[arg-type]


def fault(socket: Connection, message: str) -> str:
    """Send a message that is refused; returns why."""
    socket.send(message)
    while not (isinstance(text := socket.recv(timeout=60), str) and "fault" in (answer := json.loads(text))):
        pass
    return str(answer["fault"])


def test_roles_revocation_and_audit_trail(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "drivers.json"
    tokens = {role: drivers.add(file, f"the-{role}", role) for role in DriverRole}
    with served(tmp_path, ServerParams(port=0), Drivers(file)) as cockpit:
        session, fleet = cockpit.desk.station.driver_session, cockpit.street.fleet
        fleet.join("car", "desk", "operator")
        with pytest.raises(InvalidStatus):
            page(cockpit, "x" * 64)
        join = '{"do": "join", "vehicle": "car"}'
        with page(cockpit, tokens[DriverRole.OBSERVER]) as observer, page(cockpit, tokens[DriverRole.DRIVER]) as driver:
            assert "requires driver" in fault(observer, '{"do": "take"}')
            assert "requires operator" in fault(driver, join)
            driver.send('{"do": "take"}')
            until(lambda: (session.holder() or "").startswith("the-driver"))
            observer.send('{"do": "stop"}')
            until(lambda: session.latched)
            assert "requires driver" in fault(observer, '{"do": "unlatch"}')
            drivers.revoke(file, "the-driver")
            until(lambda: session.holder() is None)
            assert session.release_reason == "the driver's access was revoked"
            with pytest.raises(ConnectionClosed):
                while True:
                    driver.recv(timeout=60)
            assert observer.recv(timeout=60), "others stay connected"
        with pytest.raises(InvalidStatus):
            page(cockpit, tokens[DriverRole.DRIVER])

        def logged() -> list[tuple[str, str]]:
            return [(one["what"], one["by"].split(" ")[0]) for one in fleet.audit.newest]

        until(lambda: len(logged()) >= 4)
        assert logged() == [
            ("join", "operator"),
            ("take control", "the-driver"),
            ("press emergency stop", "the-observer"),
            ("release control: the driver's access was revoked", "the-driver"),
        ]
        assert all(one["vehicle"] == "car" for one in fleet.audit.newest)
        assert [one.getMessage() for one in caplog.records if one.name.endswith("station.web")] == []


def test_commands_add_list_and_revoke_drivers(tmp_path: Path) -> None:
    file = tmp_path / "drivers.json"

    def run(*words: str) -> str:
        done = CliRunner().invoke(app, ["teleop", "drivers", str(file), *words])
        assert done.exit_code == 0, done.output
        return done.output

    output = run("--add", "anna", "--role", "operator", "--days", "30")
    token = output.split("token of anna: ")[1].split()[0]
    found = Drivers(file).identify(token)
    assert found is not None and found.role == DriverRole.OPERATOR and found.expires is not None
    run("--add", "ben")
    assert "anna" not in run("--revoke", "anna") and "ben" in run()
