"""Gamepads, wheels and pedals on the driver page and on the page that sets them up, with emulated devices."""

from __future__ import annotations

import functools
import http.server
import json
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.fakes.browser import Page, chromium

EMULATED = """
pads = [];
navigator.getGamepads = () => pads;
plug = (id, mapping, axes, buttons) => pads.push({
  id, mapping, index: pads.length, connected: true, axes: Array(axes).fill(0),
  buttons: Array.from({length: buttons}, () => ({value: 0, pressed: false, touched: false})),
});
hold = (pad, button, value) => Object.assign(pads[pad].buttons[button], {value, pressed: value > 0.5});
0
"""
G29 = "Logitech G29 Driving Force Racing Wheel (Vendor: 046d Product: c24f)"
STEERING, THROTTLE, BRAKE = 0, 2, 3
"""Axes of the G29 on Linux."""


@pytest.fixture(scope="module")
def pages() -> Iterator[str]:
    """URL of the static pages, without a station."""
    handler = functools.partial(_Quiet, directory=str(ROOT / "services"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/pages/"
        server.shutdown()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """Log nothing."""


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def browser(opened: Page, pages: str) -> Page:
    """The page of the module's browser, which has stored no devices."""
    opened.do("Page.navigate", url="about:blank")
    opened.do("Storage.clearDataForOrigin", origin=pages.removesuffix("/pages/"), storageTypes="local_storage")
    opened.errors.clear()
    return opened


@pytest.fixture
def page(browser: Page, pages: str) -> Page:
    """The driver page, without a station, and emulated devices."""
    open_page(browser, f"{pages}cockpit.html", "typeof controls === 'function' && document.readyState === 'complete'")
    return browser


def open_page(page: Page, url: str, ready: str) -> None:
    page.do("Page.navigate", url=url)
    page.until(ready)
    page.value(EMULATED)


def controls(page: Page, times: int = 30) -> dict[str, float]:
    """Controls after some periods."""
    page.value("chooseGamepad(), 0")
    found: dict[str, float] = page.value(
        f"(() => {{ for (let i = 0; i < {times}; i++) controls(); return controls(); }})()"
    )
    return {name: round(value, 3) + 0.0 for name, value in found.items()}


def axes(page: Page, **values: float) -> None:
    index = {"steering": STEERING, "throttle": THROTTLE, "brake": BRAKE}
    page.value("; ".join(f"pads[0].axes[{index[name]}] = {value}" for name, value in values.items()) + "; 0")


def test_wheel_with_inverted_pedals_drives_after_its_pedals_were_at_rest(page: Page) -> None:
    page.value(f"plug({G29!r}, '', 6, 24)")
    page.value("hold(0, 5, 1)")
    assert controls(page)["throttle"] == 0 and controls(page)["brake"] > 0.4, "its axes report 0 until they are moved"
    assert "Press and release each pedal" in page.value("inputText()")
    axes(page, throttle=1, brake=1)
    assert controls(page) == {"steering": 0, "throttle": 0, "brake": 0}
    assert page.value("inputText()") == "Logitech G29 is in use."
    axes(page, throttle=-1, steering=-0.5)
    found = controls(page)
    assert found["throttle"] == 1 and found["steering"] == pytest.approx(0.495, abs=0.01), "left is positive"
    axes(page, brake=0)
    assert controls(page)["throttle"] == 0 and controls(page)["brake"] == pytest.approx(0.485, abs=0.01)
    assert page.value("emergency()") is False
    page.value("hold(0, 1, 1)")
    assert page.value("emergency()") is True


def test_any_brake_wins_over_all_pairs_of_devices(page: Page) -> None:
    """A device drives; the brake of each of the others, and its own, stops it."""
    page.value(f"plug({G29!r}, '', 6, 24); plug('pad', 'standard', 4, 17)")
    rest = (
        "pads[0].axes.splice(0, 6, 0, 0, 1, 1, 0, 0); pressed.clear();"
        "for (const pad of [0, 1]) for (const button of [1, 6, 7]) hold(pad, button, 0); 0"
    )
    throttles = {
        "wheel": "pads[0].axes[2] = -1, gamepad = 0",
        "pad": "hold(1, 7, 1), gamepad = 1",
        "keys": "pressed.add('KeyW'), gamepad = null",
    }
    brakes = {
        "wheel": "pads[0].axes[3] = -1",
        "pad": "hold(1, 6, 1)",
        "keys": "pressed.add('Space')",
        "page": "pressed.add('Button')",
    }
    for throttle, press in throttles.items():
        for brake, stop in brakes.items():
            page.value(rest)
            page.value("controls(), controls(), 0")
            page.value(f"{press}; 0")
            step = "(() => { for (let i = 0; i < 60; i++) controls(); return controls(); })()"
            assert page.value(step)["throttle"] == 1, throttle
            page.value(f"{stop}; 0")
            first = page.value("controls()")
            assert first["throttle"] == 0 and first["brake"] > 0, f"{brake} while {throttle}: at once"
            assert page.value(step)["brake"] == 1, f"{brake} while {throttle}"
    assert not page.errors


def test_unknown_device_neither_drives_nor_is_misread(page: Page) -> None:
    page.value("plug('Odd Box', '', 4, 12); hold(0, 7, 1)")
    assert controls(page) == {"steering": 0, "throttle": 0, "brake": 0} and page.value("gamepad") is None
    assert "Odd Box is unknown" in page.value("inputText()")


def test_dead_zone_and_curve(page: Page) -> None:
    page.value("plug('pad', 'standard', 4, 17)")
    page.value("storeProfile(pads[0], {...STANDARD, throttle: {...STANDARD.throttle, dead: 0.2, curve: 2}})")
    shares = []
    for value in (0.0, 0.2, 0.6, 1.0):
        page.value(f"hold(0, 7, {value}); gamepad = 0")
        shares.append(controls(page)["throttle"])
    assert shares == [0, 0, 0.25, 1]


def test_calibration_finds_axes_and_is_used_by_the_driver_page(pages: str, browser: Page) -> None:
    """An unknown wheel: steering on axis 3 (reversed), throttle on axis 1 (inverted), brake on axis 0, button 9."""
    rest = {"3": 0, "1": 1, "0": -1}
    page = browser
    open_page(page, f"{pages}devices.html", "typeof devices === 'object' && document.readyState === 'complete'")
    page.value("plug('Odd Box', '', 4, 12)")
    page.until("document.querySelector('#devices button') !== null")
    button = "document.querySelector('#devices button').click(), 0"
    page.value(button)
    for step in ({}, {"3": 1}, {"3": -1}, {"1": -1}, {"0": 1}, None):
        page.value(f"Object.entries({json.dumps(rest | (step or {}))}).forEach(([i, v]) => pads[0].axes[i] = v); 0")
        page.value(f"hold(0, 9, {int(step is None)}); 0")
        page.value(button)
    assert page.value("document.querySelector('#devices .failure').textContent") == ""
    stored = page.value("JSON.parse(localStorage.getItem('device Odd Box'))")
    assert stored["steering"] | {"dead": 0, "curve": 0} == {
        "axis": 3,
        "left": 1,
        "right": -1,
        "dead": 0,
        "curve": 0,
    }
    assert (stored["throttle"]["axis"], stored["throttle"]["rest"], stored["throttle"]["full"]) == (1, 1, -1)
    assert (stored["brake"]["axis"], stored["brake"]["rest"], stored["brake"]["full"]) == (0, -1, 1)
    assert stored["emergency"] == 9
    page.value(
        "(one => { one.value = 0.1; one.dispatchEvent(new Event('change')); })"
        "(document.querySelector('[data-setting=\"brake dead\"]')), 0"
    )
    assert page.value("JSON.parse(localStorage.getItem('device Odd Box')).brake.dead") == 0.1
    open_page(page, f"{pages}cockpit.html", "typeof controls === 'function' && document.readyState === 'complete'")
    page.value("plug('Odd Box', '', 4, 12); pads[0].axes.splice(0, 4, -1, 1, 0, 0); hold(0, 2, 1)")
    controls(page)
    page.value("pads[0].axes[1] = -1; pads[0].axes[3] = -1; 0")
    found = controls(page)
    assert found == {"steering": -1, "throttle": 1, "brake": 0}, "the wheel is at the right"
    assert not page.errors


def test_calibration_reports_what_was_not_moved(pages: str, browser: Page) -> None:
    page = browser
    open_page(page, f"{pages}devices.html", "typeof devices === 'object' && document.readyState === 'complete'")
    page.value("plug('Odd Box', '', 4, 12)")
    page.until("document.querySelector('#devices button') !== null")
    for _ in range(7):
        page.value("document.querySelector('#devices button').click(), 0")
    assert "The wheel did not move" in page.value("document.querySelector('#devices .failure').textContent")
    assert page.value("localStorage.getItem('device Odd Box')") is None
