"""A street whose station serves its page, for tests of the page; and the station in its own process."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access.drivers import Access
from scan2sim.services.teleoperation.station.road_map import MapLine
from scan2sim.services.teleoperation.station.web import PageHub, application
from tests.fakes.ports import free_port
from tests.services.teleoperation.street import HERE, Desk, Street
from tests.waiting import until


@dataclass
class Cockpit:
    """A street whose station serves its page."""

    street: Street
    desk: Desk
    app: Any
    hub: PageHub
    url: str = ""

    def connected_pages(self) -> int:
        """Number of connected pages."""
        return len(self.hub._pages)


@contextmanager
def served(
    tmp_path: Path, params: ServerParams, drivers: Access | None = None, map_lines: Sequence[MapLine] = ()
) -> Iterator[Cockpit]:
    """Serve the page of a street's station."""
    street = Street(tmp_path)
    urls: list[str] = []
    try:
        cockpit = page_of(street, params, drivers, map_lines)
        threading.Thread(target=factory.run, args=(cockpit.app, params, urls.append), daemon=True).start()
        until(lambda: urls)
        cockpit.url = urls[0]
        yield cockpit
    finally:
        street.close()


def page_of(
    street: Street, params: ServerParams, drivers: Access | None = None, map_lines: Sequence[MapLine] = ()
) -> Cockpit:
    desk = street.desk()
    hub = PageHub(lambda frame: joined.age(frame.captured) if (joined := desk.station.joined()) else 0.0)
    desk.show = hub.show
    desk.station.report_event = desk.gateway_connection.report_event
    app = application(params, desk.station, hub, lambda what, vehicle, driver: True, drivers, map_lines)
    return Cockpit(street, desk, app, hub)


@contextmanager
def station_process(street: Street) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the command `teleop station` for the street's station; yields the process and the URL of its page."""
    arguments = [street.parties / "station-desk", f"{HERE}:{street.gateway.port}"]
    arguments += ["--listening", f"{HERE}:{free_port()}", "--port", free_port()]
    command = [sys.executable, "-m", "scan2sim.flows.cli", "teleop", "station", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            page = next((line for line in process.stdout if "the driver page is" in line), "")
            yield process, page.split()[-1]
        finally:
            process.kill()
