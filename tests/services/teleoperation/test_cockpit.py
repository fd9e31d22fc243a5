"""The driver's page, in a browser: pictures with their age, the wheel, the confirmation; who leaves lets go."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from scan2sim.services import serving
from scan2sim.services.served import Served
from scan2sim.services.teleoperation.cockpit import Screens, application
from tests.browser import Page, chromium
from tests.services.teleoperation.street import Desk, Street, until

TOKEN = "0123456789abcdef/+="


@dataclass
class Cockpit:
    """A street whose desk has its page."""

    street: Street
    desk: Desk
    app: Any
    url: str = ""


@contextmanager
def served(tmp_path: Path, params: Served) -> Iterator[Cockpit]:
    """A street whose desk's page is served."""
    street = Street(tmp_path)
    told: list[str] = []
    try:
        made = page_of(street, params)
        threading.Thread(target=serving.run, args=(made.app, params, told.append), daemon=True).start()
        until(lambda: told)
        made.url = told[0]
        yield made
    finally:
        street.close()


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    with served(tmp_path, Served(port=0)) as made:
        yield made


def page_of(street: Street, params: Served) -> Cockpit:
    desk = street.desk()
    screens = Screens(lambda frame: joined.age(frame.captured) if (joined := desk.station.joined()) else 0.0)
    desk.show = screens.show
    return Cockpit(street, desk, application(params, desk.station, screens, lambda what, vehicle: True))


def live(cockpit: Cockpit, **more: Any) -> ClientConnection:
    """The page's WebSocket."""
    return connect(cockpit.url.replace("http", "ws") + "live", **more)


def driving(page: Page, cockpit: Cockpit) -> None:
    """From the page that was opened to a vehicle that drives."""
    cockpit.street.fleet.join("car", "desk", "operator")
    page.do("Page.navigate", url=cockpit.url)
    page.until("document.querySelector('figure')?.dataset.shown > 3")
    page.click("#take")
    page.until("!document.getElementById('agree').disabled")
    page.click("#agree")
    until(lambda: not cockpit.desk.standing())


def test_a_driver_sees_how_old_the_picture_is_confirms_and_drives_by_keys(cockpit: Cockpit, tmp_path: Path) -> None:
    with chromium(tmp_path) as page:
        driving(page, cockpit)
        age = page.value("Number(document.querySelector('figure').dataset.age)")
        assert 0 <= age < 5000 and page.value("Number(document.getElementById('age').textContent)") >= 0
        assert "front" in page.value("document.querySelector('figcaption').textContent")
        page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="ArrowUp", key="ArrowUp")
        until(lambda: cockpit.street.wheels.controls.throttle > 0.5)
        page.do("Input.dispatchKeyEvent", type="keyUp", code="ArrowUp", key="ArrowUp")
        until(lambda: cockpit.street.wheels.controls.throttle == 0 and not cockpit.desk.standing())
        assert cockpit.street.wheels.controls.brake == 0, "it rolls: its driver still has the wheel"
        assert not page.errors


def test_a_page_in_the_background_lets_go_and_says_so(cockpit: Cockpit, tmp_path: Path) -> None:
    with chromium(tmp_path) as page:
        driving(page, cockpit)
        page.value(
            "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
        until(cockpit.desk.standing)
        assert cockpit.desk.station.wheel.held_by() is None
        page.until("document.getElementById('standing').textContent.includes('in the background')")


def test_a_page_that_is_closed_lets_go(cockpit: Cockpit, tmp_path: Path) -> None:
    with chromium(tmp_path) as page:
        driving(page, cockpit)
    until(cockpit.desk.standing)
    assert cockpit.desk.station.wheel.held_by() is None


def test_pages_need_the_token_and_other_sites_are_kept_out(tmp_path: Path) -> None:
    (tmp_path / "token").write_text(TOKEN)
    with served(tmp_path, Served(port=0, token=tmp_path / "token")) as cockpit:
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"{cockpit.url}api/station", timeout=20)
        for protocols in (None, ["scan2sim"], ["scan2sim", "token.ff"], ["token.zz"]):
            with pytest.raises(InvalidStatus):
                live(cockpit, subprotocols=protocols)
        named = ["scan2sim", f"token.{TOKEN.encode().hex()}"]
        with live(cockpit, subprotocols=named) as socket:
            assert socket.subprotocol == "scan2sim" and json.loads(socket.recv())["station"] == "desk"
        with pytest.raises(InvalidStatus):
            live(cockpit, subprotocols=named, origin="https://evil.example")


def test_what_a_page_says_amiss_is_told_and_ends_nothing(cockpit: Cockpit) -> None:
    with live(cockpit) as socket:
        for said in (
            "",
            "[]",
            '{"do": "fly"}',
            '{"do": "turn", "steering": NaN}',
            '{"do": "turn", "steering": 2}',
            "x" * 999,
        ):
            socket.send(said)
            while "fault" not in (told := json.loads(socket.recv())):
                pass
            assert "can't be understood" in told["fault"]
        socket.send('{"do": "take"}')
        until(lambda: "page" in (json.loads(socket.recv()).get("driver") or ""))
