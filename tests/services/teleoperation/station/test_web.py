"""The driver page in a browser: video with its age, control lock, confirmation; leaving the page releases the lock."""

from __future__ import annotations

import itertools
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

from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from tests.fakes.browser import Page, chromium
from tests.fakes.driver_controls import hold
from tests.services.teleoperation.pages import Cockpit, served
from tests.waiting import until

TOKEN = "0123456789abcdef/+="


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    with served(tmp_path, ServerParams(port=0)) as running:
        yield running


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture
def page(browser: Page) -> Iterator[Page]:
    """The page of the module's browser, blank before and after each test."""
    browser.errors.clear()
    browser.do("Emulation.setTouchEmulationEnabled", enabled=False)
    yield browser
    browser.do("Page.navigate", url="about:blank")


def live(cockpit: Cockpit, **more: Any) -> ClientConnection:
    """The WebSocket of the page."""
    return connect(cockpit.url.replace("http", "ws") + "live", **more)


def start_driving(page: Page, cockpit: Cockpit) -> None:
    """Open the page, and operate it until the vehicle drives."""
    cockpit.street.fleet.join("car", "desk", "operator")
    page.do("Page.navigate", url=cockpit.url)
    page.until("document.querySelector('figure')?.dataset.shown > 3")
    press(page, "#take", lambda: cockpit.desk.station.driver_session.holder() is not None)
    press(page, "#agree", lambda: not cockpit.desk.standing())


RECORD_SENT = "sent = []; sending = send; send = (one) => { sent.push(one); sending(one); }; 0"
"""Keep all messages of the page in its variable `sent`."""


def send_commands(page: Page, cockpit: Cockpit, count: int) -> None:
    """Make a page that drives send some commands without pauses; wait until the vehicle has received the last one.

    The page changes the values of keys by a fixed step per command: fully within 10 commands, the throttle within 42.
    """
    lights = page.value(f"lights = !lights; for (let i = 0; i < {count}; i++) sendCommand(); lights")
    until(lambda: cockpit.street.car.controls.lights == lights)


def await_commands(page: Page, count: int) -> None:
    """Wait until a page that drives has sent some more commands; it sends one per period."""
    before = page.value("sent.length")
    page.until(f"sent.length >= {before + count}")


GAMEPADS = """
buttons = [0, 1].map(() => Array.from({length: 17}, () => ({value: 0, pressed: false, touched: false})));
navigator.getGamepads = () => [0, 1].map((index) => (
  {index, connected: true, mapping: "standard", axes: [0, 0, 0, 0], buttons: buttons[index]}));
0
"""
"""Two gamepads at rest."""
TOUCH_BY_ACCIDENT = """
touched = false;
byId("unlatch").dispatchEvent(new PointerEvent("pointerdown"));
setTimeout(() => { byId("unlatch").dispatchEvent(new PointerEvent("pointerup")); touched = true; }, 200);
0
"""
"""By a timer of the page, which fires before the one of the button, also if the page stalls."""
SHORTER_TIMERS = "whole = setTimeout; setTimeout = (call, ms) => whole(call, ms / 5); 0"
"""For repetitions: the button that ends a stop is held for 0.2 s, and touched by accident for 40 ms."""
BRAKES = ("space", "down", "S", "mouse on brake", "finger on brake", "left trigger", "other gamepad's left trigger")
STOPS = ("escape", "backspace", "mouse on stop", "finger on stop", "button B", "other gamepad's button B")


def press(page: Page, button: str, done: Callable[[], bool]) -> None:
    """Press a button, repeatedly in case a busy machine was too slow."""
    end = time.monotonic() + 120
    while not done():
        assert time.monotonic() < end, page.value("document.body.innerText")
        if page.value(f"!document.querySelector('{button}').disabled"):
            page.click(button)
        retry = time.monotonic() + 3
        while not done() and time.monotonic() < retry:
            time.sleep(0.02)


def test_driver_sees_the_video_age_confirms_and_drives_by_keyboard(cockpit: Cockpit, page: Page) -> None:
    start_driving(page, cockpit)
    age = page.value("Number(document.querySelector('figure').dataset.age)")
    assert 0 <= age < 5000 and page.value("Number(document.getElementById('age').textContent)") >= 0
    assert "front" in page.value("document.querySelector('figcaption').textContent")
    page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="ArrowUp", key="ArrowUp")
    until(lambda: cockpit.street.car.controls.throttle > 0.5)
    page.do("Input.dispatchKeyEvent", type="keyUp", code="ArrowUp", key="ArrowUp")
    until(lambda: cockpit.street.car.controls.throttle == 0 and not cockpit.desk.standing())
    assert cockpit.street.car.controls.brake == 0, "it rolls: its driver still holds the lock"
    shown = "[...document.querySelectorAll('#cameras b')].map((one) => one.textContent)"
    assert page.value(f"camera(2), camera(1), {shown}") == ["front", "camera 1", "camera 2"], "the first is largest"
    assert not page.errors


def test_any_brake_overrides_any_throttle(cockpit: Cockpit, page: Page) -> None:
    """Full throttle and a brake on the same device or another: at the vehicle, and in all that the page sends."""
    throttles = ("up", "right trigger")
    car = cockpit.street.car
    start_driving(page, cockpit)
    page.value(GAMEPADS)
    page.do("Emulation.setTouchEmulationEnabled", enabled=True)
    page.value(RECORD_SENT)
    for throttle, brake in itertools.product(throttles, BRAKES):
        press(page, "#agree", lambda: not cockpit.desk.standing())
        page.value("gamepad = null; 0")  # the next gamepad with a pressed button is used
        hold(page, throttle, True)
        send_commands(page, cockpit, 50)
        until(lambda: car.controls.throttle > 0.9)
        hold(page, brake, True)
        send_commands(page, cockpit, 15)
        until(lambda: car.controls.brake > 0.9)
        assert car.controls.throttle == 0, f"{brake} while {throttle} is held"
        hold(page, brake, False)
        send_commands(page, cockpit, 15)
        until(lambda: car.controls.brake == 0)
        hold(page, throttle, False)
        send_commands(page, cockpit, 15)
        until(lambda: car.controls.throttle == 0)
    braked = "sent.filter((one) => one.do === 'turn' && one.brake > 0)"
    assert page.value(f"{braked}.length") > 0 and page.value(f"{braked}.every((one) => one.throttle === 0)")
    assert not page.errors


def test_brake_holds_until_the_last_of_two_inputs_is_released(cockpit: Cockpit, page: Page) -> None:
    car = cockpit.street.car
    start_driving(page, cockpit)
    page.value(GAMEPADS)
    page.do("Emulation.setTouchEmulationEnabled", enabled=True)
    page.value(RECORD_SENT)
    for first, last in itertools.permutations(BRAKES, 2):
        if {first, last} == {"mouse on brake", "finger on brake"}:
            continue  # both press the same button
        press(page, "#agree", lambda: not cockpit.desk.standing())
        hold(page, first, True)
        hold(page, last, True)
        until(lambda: car.controls.brake == 1)
        send_commands(page, cockpit, 25)
        released = page.value("sent.length")
        hold(page, first, False)
        send_commands(page, cockpit, 10)
        commands = page.value(f"sent.slice({released}).filter((one) => one.do === 'turn')")
        assert {(one["brake"], one["throttle"]) for one in commands} == {(1, 0)}, f"{first}, then {last}"
        assert car.controls.brake == 1 and car.controls.throttle == 0, f"{first}, then {last}"
        hold(page, last, False)
        send_commands(page, cockpit, 15)
        until(lambda: car.controls.brake == 0)
    assert not page.errors


def test_emergency_stop_latches_until_it_is_released_deliberately(cockpit: Cockpit, page: Page) -> None:
    """From every device, while the throttle of another is held."""
    car, session = cockpit.street.car, cockpit.desk.station.driver_session
    start_driving(page, cockpit)
    page.value(GAMEPADS)
    page.do("Emulation.setTouchEmulationEnabled", enabled=True)
    page.value(RECORD_SENT)
    for number, (throttle, stop) in enumerate(itertools.product(("up", "right trigger"), STOPS)):
        if number == 1:
            page.value(SHORTER_TIMERS)
        press(page, "#agree", lambda: not cockpit.desk.standing())
        page.value("gamepad = null; 0")
        hold(page, throttle, True)
        send_commands(page, cockpit, 50)
        until(lambda: car.controls.throttle > 0.9)
        hold(page, stop, True)
        until(lambda: car.controls.brake == 1)
        hold(page, stop, False)
        hold(page, throttle, False)
        page.until("!byId('latched').hidden && byId('agree').disabled")
        page.value(TOUCH_BY_ACCIDENT)
        page.until("touched")
        page.value("for (let i = 0; i < 25; i++) sendCommand()")
        await_commands(page, 5)
        assert session.latched and cockpit.desk.standing() and car.controls.brake == 1, stop
        hold(page, "finger on unlatch", True)
        until(lambda: not session.latched)
        hold(page, "finger on unlatch", False)
        assert cockpit.desk.standing(), "the driver has to confirm"
    assert not page.errors


def test_any_page_can_stop_but_only_the_driver_ends_the_stop(cockpit: Cockpit, page: Page) -> None:
    session = cockpit.desk.station.driver_session
    with live(cockpit) as watcher:
        start_driving(page, cockpit)
        watcher.send('{"do": "stop"}')
        until(cockpit.desk.standing)
        until(lambda: "emergency stop" in page.value("byId('standing').textContent"))
        watcher.send('{"do": "unlatch"}')
        while "ended by the driver only" not in str(watcher.recv(timeout=60)):  # after what was sent before
            pass
        assert session.latched
        page.value("byId('unlatch').focus()")
        page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="Enter", key="Enter")
        until(lambda: not session.latched)
        page.do("Input.dispatchKeyEvent", type="keyUp", code="Enter", key="Enter")
        press(page, "#agree", lambda: not cockpit.desk.standing())


def test_gear_changes_only_if_the_vehicle_is_known_to_stand(cockpit: Cockpit, page: Page) -> None:
    """A speed that is outdated or not reported isn't zero."""
    start_driving(page, cockpit)

    def press_r(vehicle: str) -> int:
        page.value(f"freshVehicle = () => ({vehicle}); 0")
        page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="KeyR", key="r")
        page.do("Input.dispatchKeyEvent", type="keyUp", code="KeyR", key="r")
        return int(page.value("gear"))

    assert press_r("{speed: 2, gear: 1}") == 1
    until(lambda: "The gear stays: the vehicle is moving" in page.value("byId('standing').textContent"))
    assert press_r("undefined") == 1 and press_r("{speed: null, gear: 1}") == 1
    until(lambda: "brake while you press R" in page.value("byId('standing').textContent"))
    page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="Space", key=" ")
    assert press_r("undefined") == 1 and press_r("{speed: null, gear: 1}") == -1
    page.do("Input.dispatchKeyEvent", type="keyUp", code="Space", key=" ")
    assert press_r("{speed: -2, gear: -1}") == -1 and press_r("{speed: 0.1, gear: -1}") == 1
    until(lambda: "The gear stays" not in page.value("byId('standing').textContent"))


def test_leaving_full_screen_by_the_browser_is_an_emergency_stop(cockpit: Cockpit, page: Page) -> None:
    """Escape leaves full screen before the page sees the key, in browsers that can't lock it."""
    start_driving(page, cockpit)
    page.click("#full")
    page.until("document.fullscreenElement !== null")
    page.click("#full")
    page.until("document.fullscreenElement === null && !leavingFullScreen")  # the page has handled it
    assert not page.value("stopping"), "left by the page's button"
    assert not cockpit.desk.station.driver_session.latched
    page.click("#full")
    page.until("document.fullscreenElement !== null")
    page.value("document.exitFullscreen(); 0")
    until(lambda: cockpit.desk.station.driver_session.latched)


def test_brake_key_works_with_modifiers_and_presses_no_button(cockpit: Cockpit, page: Page) -> None:
    start_driving(page, cockpit)
    page.value("document.getElementById('leave').focus()")
    for ctrl in (0, 2):
        page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="Space", key=" ", modifiers=ctrl)
        until(lambda: cockpit.street.car.controls.brake == 1 and not cockpit.desk.standing())
        page.do("Input.dispatchKeyEvent", type="keyUp", code="Space", key=" ", modifiers=ctrl)
        until(lambda: cockpit.street.car.controls.brake == 0)
    assert cockpit.desk.station.driver_session.holder() is not None


def test_brake_overrides_the_throttle_in_messages_of_a_page(cockpit: Cockpit) -> None:
    session = cockpit.desk.station.driver_session
    with live(cockpit) as socket:
        socket.send('{"do": "take"}')
        socket.send('{"do": "turn", "steering": 0, "throttle": 1, "brake": 0.1, "gear": 1}')
        until(lambda: session.command(0.0) is not None)
        assert session.command(0.0) == Command(Controls(0.0, 0.0, 0.1, Gear.FORWARD))


def test_page_in_the_background_releases_the_lock_and_reports_it(cockpit: Cockpit, page: Page) -> None:
    start_driving(page, cockpit)
    page.value(
        "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    until(lambda: cockpit.desk.standing() and cockpit.desk.station.driver_session.holder() is None)
    page.until("document.getElementById('standing').textContent.includes('in the background')")


def test_closed_page_releases_the_lock(cockpit: Cockpit, tmp_path: Path) -> None:
    with chromium(tmp_path) as page:
        start_driving(page, cockpit)
    until(lambda: cockpit.desk.standing() and cockpit.desk.station.driver_session.holder() is None)


def test_pages_need_the_token_and_other_origins_are_refused(tmp_path: Path) -> None:
    (tmp_path / "token").write_text(TOKEN, encoding="utf-8")
    with served(tmp_path, ServerParams(port=0, token=tmp_path / "token")) as cockpit:
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(f"{cockpit.url}api/station", timeout=60)
        for protocols in (None, ["scan2sim"], ["scan2sim", "token.ff"], ["token.zz"]):
            with pytest.raises(InvalidStatus):
                live(cockpit, subprotocols=protocols)
        named = ["scan2sim", f"token.{TOKEN.encode().hex()}"]
        with live(cockpit, subprotocols=named) as socket:
            assert socket.subprotocol == "scan2sim" and json.loads(socket.recv())["station"] == "desk"
        with pytest.raises(InvalidStatus):
            live(cockpit, subprotocols=named, origin="https://evil.example")


def test_invalid_page_messages_are_reported_and_the_connection_stays(cockpit: Cockpit) -> None:
    with live(cockpit) as socket:
        for message in (
            "",
            "[]",
            '{"do": "fly"}',
            '{"do": "turn", "steering": NaN}',
            '{"do": "turn", "steering": 2}',
            "x" * 999,
        ):
            socket.send(message)
            while "fault" not in (answer := json.loads(socket.recv())):
                pass
            assert "isn't valid" in answer["fault"]
        socket.send('{"do": "take"}')
        until(lambda: "page" in (json.loads(socket.recv()).get("driver") or ""))
