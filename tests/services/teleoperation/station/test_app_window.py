"""The driver page in its own window, on a virtual display."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.station import app_window
from tests.services.teleoperation.pages import Cockpit, served
from tests.waiting import until


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A virtual display; the test is skipped if none can be created."""
    for program, package in (("Xvfb", "xvfb"), ("xwininfo", "x11-utils"), ("chromium", "chromium")):
        if shutil.which(program) is None:
            pytest.skip(f"{program} isn't installed (apt-get install {package})")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1400x900x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as process:
        os.close(write)
        with os.fdopen(read) as answer:
            number = answer.readline().strip()
        assert number, "Xvfb doesn't start"
        monkeypatch.setenv("DISPLAY", f":{number}")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        yield f":{number}"
        process.terminate()


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    with served(tmp_path, ServerParams(port=0)) as running:
        yield running


@pytest.mark.slow
def test_page_opens_in_a_window_and_closing_it_disconnects(cockpit: Cockpit, display: str) -> None:
    def windows() -> str:
        for _ in range(20):  # the command fails if a window closes meanwhile
            listed = subprocess.run(["xwininfo", "-root", "-tree"], capture_output=True, text=True)
            if listed.returncode == 0:
                return listed.stdout
        raise AssertionError(listed.stderr)

    cockpit.street.fleet.join("car", "desk", "operator")
    with app_window.window(cockpit.url) as process:
        until(lambda: "Teleoperation" in windows())
        until(lambda: cockpit.connected_pages() == 1)
        assert process.poll() is None
    until(lambda: cockpit.connected_pages() == 0)
    assert "Teleoperation" not in windows()


def test_missing_display_or_browser_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UnavailableError, match="a display"), app_window.window("http://localhost/"):
        pass
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(UnavailableError, match="chromium"), app_window.window("http://localhost/"):
        pass
