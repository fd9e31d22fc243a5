"""A street whose desk has its page, for tests that look at it; and the desk as a process of its own."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.services.http import factory
from scan2sim.services.http.settings import Served
from scan2sim.services.teleoperation.station.web import Screens, application
from tests.fakes.ports import free_port
from tests.services.teleoperation.street import HERE, Desk, Street, until


@dataclass
class Cockpit:
    """A street whose desk has its page."""

    street: Street
    desk: Desk
    app: Any
    screens: Screens
    url: str = ""

    def watched(self) -> int:
        """Pages that watch."""
        return len(self.screens._pages)


@contextmanager
def served(tmp_path: Path, params: Served) -> Iterator[Cockpit]:
    """A street whose desk's page is served."""
    street = Street(tmp_path)
    told: list[str] = []
    try:
        made = page_of(street, params)
        threading.Thread(target=factory.run, args=(made.app, params, told.append), daemon=True).start()
        until(lambda: told)
        made.url = told[0]
        yield made
    finally:
        street.close()


def page_of(street: Street, params: Served) -> Cockpit:
    desk = street.desk()
    screens = Screens(lambda frame: joined.age(frame.captured) if (joined := desk.station.joined()) else 0.0)
    desk.show = screens.show
    app = application(params, desk.station, screens, lambda what, vehicle: True)
    return Cockpit(street, desk, app, screens)


@contextmanager
def station_process(street: Street) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command `teleop station` for the street's desk, and the address of its page."""
    words = [street.parties / "station-desk", f"{HERE}:{street.gateway.port}"]
    words += ["--listening", f"{HERE}:{free_port()}", "--port", free_port()]
    command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", "station", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            page = next((line for line in process.stdout if "the driver's page is" in line), "")
            yield process, page.split()[-1]
        finally:
            process.kill()
