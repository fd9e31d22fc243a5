"""Headless Chromium, controlled by its DevTools protocol, for tests of web pages."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

FLAGS = (
    "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--remote-debugging-port=0",
)  # fmt: skip
EXECUTABLES = ("chromium", "chromium-browser", "google-chrome")


class Page:
    """A page in the browser."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._ids = itertools.count(1)
        self.errors: list[str] = []
        self._worker = ""

    def do(self, method: str, *, session: str = "", **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result; collects uncaught exceptions of the page in `errors`.

        Args:
            session: of a worker of the page; empty: the page itself.
        """
        number = next(self._ids)
        to = {"sessionId": session} if session else {}
        self._socket.send(json.dumps({"id": number, "method": method, "params": params, **to}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(message["params"])[:1000])
            if message.get("method") == "Target.attachedToTarget":
                self._worker = message["params"]["sessionId"]
            if message.get("id") == number:
                assert "error" not in message, message
                return dict(message["result"])

    def open(self, path: Path, *, phone: bool = False, dark: bool = False, size: tuple[int, int] = (1280, 800)) -> None:
        """Open a file by its file:// URL, emulating a phone or a dark colour scheme, and wait until it is loaded.

        Args:
            path: the file.
            phone: emulate a phone.
            dark: emulate a dark colour scheme.
            size: width and height of the window in pixels, except of a phone.
        """
        width, height = (390, 844) if phone else size
        self.do("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        self.do("Emulation.setTouchEmulationEnabled", enabled=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.do("Emulation.setEmulatedMedia", features=[scheme])
        self.do("Page.navigate", url=path.resolve().as_uri())
        self.until("document.readyState === 'complete'")

    def worker_value(self, script: str) -> Any:
        """Evaluate a JavaScript expression in the page's worker; waits for the worker."""
        end = time.monotonic() + 60
        while not self._worker:
            self.do("Target.setAutoAttach", autoAttach=True, waitForDebuggerOnStart=False, flatten=True)
            assert time.monotonic() < end, "the page has no worker"
        return self.value(script, self._worker)

    def value(self, script: str, session: str = "") -> Any:
        """Evaluate a JavaScript expression; waits for promises; `session`: of a worker."""
        result = self.do("Runtime.evaluate", session=session, expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, script: str, seconds: float = 120) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.value(script):
            if time.monotonic() > end:
                shown = self.value("`${document.hidden ? 'hidden' : 'shown'}: ${document.body.innerText}`")
                raise AssertionError(f"still false after {seconds} s: {script}; errors: {self.errors}; page {shown}")
            time.sleep(0.05)

    def click(self, selector: str) -> None:
        """Click the centre of an element."""
        box = f"document.querySelector({selector!r})"
        self.value(f"{box}.scrollIntoView({{block: 'nearest'}})")
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box}.getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, code: str, key: str, seconds: float) -> None:
        """Hold a key down for some seconds."""
        for kind in ("rawKeyDown", "keyUp"):
            self.do("Input.dispatchKeyEvent", type=kind, code=code, key=key)
            time.sleep(seconds if kind == "rawKeyDown" else 0)

    def touch(self, selector: str, seconds: float, across: float = 0.0) -> None:
        """Hold a finger on the centre of an element, after moving it to the right by `across` pixels."""
        box = f"document.querySelector({selector!r}).getBoundingClientRect()"
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        self.do("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        for share in (0.5, 1.0) if across else ():
            self.do("Input.dispatchTouchEvent", type="touchMove", touchPoints=[{"x": x + share * across, "y": y}])
        time.sleep(seconds)
        self.do("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag with the left mouse button; viewport pixels."""
        self.do("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], button="left", clickCount=1)
        for share in (0.5, 1.0):
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self.do("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.do("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], button="left", clickCount=1)

    def screenshot(self, *, whole: bool = False) -> np.ndarray:
        """(H, W, 3) RGB of the viewport, or of the whole page."""
        data = self.do("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        return np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("RGB"))


@contextmanager
def chromium(folder: Path, *flags: str) -> Iterator[Page]:
    """A page in a new browser, which is closed afterwards; skips the test if Chromium isn't installed."""
    program = next(filter(None, map(shutil.which, EXECUTABLES)), None)
    if program is None:
        pytest.skip("Chromium isn't installed (apt-get install chromium)")
    connect = pytest.importorskip("websockets.sync.client", reason="websockets isn't installed").connect
    profile = folder / "profile"
    with subprocess.Popen(
        [program, *FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            end = time.monotonic() + 60
            active = profile / "DevToolsActivePort"
            while not active.is_file() or len(address := active.read_text(encoding="utf-8").split()) < 2:
                assert process.poll() is None and time.monotonic() < end, "Chromium doesn't start"
                time.sleep(0.05)
            port, path = address
            with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as browser_socket:
                browser = Page(browser_socket)
                while not (targets := browser.do("Target.getTargets", filter=[{"type": "page"}])["targetInfos"]):
                    assert time.monotonic() < end, "Chromium opens no page"
                    time.sleep(0.05)
                target = targets[0]["targetId"]  # further targets are pages of extensions
            with connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_size=None) as socket:
                page = Page(socket)
                page.do("Page.enable")
                page.do("Runtime.enable")
                yield page
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the browser and its processes, some of which still write into its profile when it has ended."""
    with suppress(psutil.NoSuchProcess):
        others = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        process.wait()
        for one in others:
            with suppress(psutil.NoSuchProcess):
                one.kill()
        psutil.wait_procs(others, timeout=10)
