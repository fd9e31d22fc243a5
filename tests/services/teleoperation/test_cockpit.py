"""The driver's page, in a browser: pictures with their age, the wheel, the confirmation; who leaves lets go."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from scan2sim.services.served import Served
from tests.browser import Page, chromium
from tests.services.teleoperation.pages import Cockpit, served
from tests.services.teleoperation.street import until

TOKEN = "0123456789abcdef/+="


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    with served(tmp_path, Served(port=0)) as made:
        yield made


def live(cockpit: Cockpit, **more: Any) -> ClientConnection:
    """The page's WebSocket."""
    return connect(cockpit.url.replace("http", "ws") + "live", **more)


def driving(page: Page, cockpit: Cockpit) -> None:
    """From the page that was opened to a vehicle that drives."""
    cockpit.street.fleet.join("car", "desk", "operator")
    page.do("Page.navigate", url=cockpit.url)
    page.until("document.querySelector('figure')?.dataset.shown > 3")
    press(page, "#take", lambda: cockpit.desk.station.wheel.held_by() is not None)
    press(page, "#agree", lambda: not cockpit.desk.standing())


def press(page: Page, button: str, done: Callable[[], bool]) -> None:
    """Press a button, again where a busy machine was too slow for what the driver asked."""
    end = time.monotonic() + 120
    while not done():
        assert time.monotonic() < end, page.value("document.body.innerText")
        if page.value(f"!document.querySelector('{button}').disabled"):
            page.click(button)
        again = time.monotonic() + 3
        while not done() and time.monotonic() < again:
            time.sleep(0.02)


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
        shown = "[...document.querySelectorAll('#cameras b')].map((one) => one.textContent)"
        assert page.value(f"camera(2), camera(1), {shown}") == ["front", "camera 1", "camera 2"], "the first is largest"
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
