"""The driver's page in a window of its own, on a display that nobody sees."""

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
from scan2sim.services.http.settings import Served
from scan2sim.services.teleoperation.station import app_window
from tests.services.teleoperation.pages import Cockpit, served
from tests.services.teleoperation.street import until


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A display; the test is skipped where none can be made."""
    for program, package in (("Xvfb", "xvfb"), ("xwininfo", "x11-utils"), ("chromium", "chromium")):
        if shutil.which(program) is None:
            pytest.skip(f"{program} isn't installed (apt-get install {package})")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1400x900x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as process:
        os.close(write)
        with os.fdopen(read) as told:
            number = told.readline().strip()
        assert number, "Xvfb doesn't start"
        monkeypatch.setenv("DISPLAY", f":{number}")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        yield f":{number}"
        process.terminate()


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    with served(tmp_path, Served(port=0)) as made:
        yield made


@pytest.mark.slow
def test_the_page_is_shown_in_a_window_and_closing_it_lets_go(cockpit: Cockpit, display: str) -> None:
    def windows() -> str:
        for _ in range(20):  # it fails where a window closes meanwhile
            listed = subprocess.run(["xwininfo", "-root", "-tree"], capture_output=True, text=True)
            if listed.returncode == 0:
                return listed.stdout
        raise AssertionError(listed.stderr)

    cockpit.street.fleet.join("car", "desk", "operator")
    with app_window.window(cockpit.url) as process:
        until(lambda: "Teleoperation" in windows())
        until(lambda: cockpit.watched() == 1)
        assert process.poll() is None
    until(lambda: cockpit.watched() == 0)
    assert "Teleoperation" not in windows()


def test_without_a_display_or_a_browser_it_is_said_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UnavailableError, match="a display"), app_window.window("http://localhost/"):
        pass
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(UnavailableError, match="chromium"), app_window.window("http://localhost/"):
        pass
