"""API and page of fleet management: what an operator sees and does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
from fastapi.testclient import TestClient

from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.web import application
from scan2sim.services.teleoperation.gateway_protocol import Hello, LinkStatus, Status
from scan2sim.services.teleoperation.identity import Peer, Role
from tests.fakes.browser import Page, chromium
from tests.waiting import until

HOSTILE = "<img src=x onerror=document.title='hacked'>"


class FakeGateway:
    def alive(self) -> bool:
        return True


def fleet_with_parties(tmp_path: Path) -> Fleet:
    fleet = Fleet(tmp_path)
    for role, name in ((Role.VEHICLE, "car"), (Role.VEHICLE, "van"), (Role.STATION, "desk"), (Role.STATION, "other")):
        orders: list[Order] = []
        fleet.connected(Peer(role, name, "0" * 64), Hello(cameras=("front",)), "10.0.0.1:5", orders.append)
    links = (LinkStatus(name="lte", up=True, round_trip=84.0, loss=0.01, rate=3.2), LinkStatus(name="wifi", up=False))
    report(fleet, Status(links=links, age=48.0, message=HOSTILE))
    return fleet


def report(fleet: Fleet, status: Status) -> None:
    fleet.update_status(Peer(Role.VEHICLE, "car", "0" * 64), status)


def app(fleet: Fleet, served: ServerParams | None = None) -> Any:
    return application(served or ServerParams(), fleet, FakeGateway())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as opened:
        yield opened
        assert opened.errors == []


def test_operator_joins_hands_over_takes_back_and_releases(tmp_path: Path) -> None:
    client = TestClient(app(fleet_with_parties(tmp_path)), base_url="http://localhost")
    assert client.post("/api/vehicles/car/join", json={"station": "desk"}).json() == {"pair": 1}
    refused = client.post("/api/vehicles/car/join", json={"station": "other"})
    assert refused.status_code == 409 and "driven from desk" in refused.json()["cause"]
    assert client.post("/api/vehicles/car/hand-over", json={"station": "other"}).json() == {"pair": 2}
    assert client.post("/api/vehicles/car/take-back").json() == {"pair": 3}
    assert client.post("/api/vehicles/car/release").status_code == 200
    assert client.post("/api/vehicles/ghost/join", json={"station": "desk"}).status_code == 422
    assert [one["what"] for one in client.get("/api/audit?count=2").json()] == ["release", "hand over"]
    assert client.get("/api/fleet").json()["vehicles"][0]["pair"] is None


def test_page_lists_parties_and_joins_them(tmp_path: Path, page: Page) -> None:
    fleet, urls = fleet_with_parties(tmp_path), list[str]()
    served = ServerParams(port=0)
    threading.Thread(target=factory.run, args=(app(fleet, served), served, urls.append), daemon=True).start()
    until(lambda: urls)
    page.do("Page.navigate", url=urls[0])
    page.until("document.querySelectorAll('#vehicles .run').length === 2")
    page.click("#vehicles .run button")
    page.until("document.querySelector('#vehicles').textContent.includes('driven from desk')")
    text = page.value("document.body.innerText")
    assert "84 ms 1.0 % lost" in text and "wifi down" in text and HOSTILE in text
    assert page.value("document.title") == "Fleet · scan2sim" and not page.errors
    assert fleet.snapshot()["vehicles"][0]["other"] == "desk"
    fleet.update_status(Peer(Role.STATION, "desk", "0" * 64), Status(pair=1, driver="anna (page 3)", held=60.0))
    for place, text in (("vehicles", "driven from desk"), ("stations", "drives car")):
        page.until(f"document.querySelector('#{place}').textContent.includes('{text} by anna (page 3) since ')")


def test_speeds_disappear_when_a_vehicle_falls_silent(tmp_path: Path, page: Page) -> None:
    fleet, urls, silent = fleet_with_parties(tmp_path), list[str](), threading.Event()
    served = ServerParams(port=0)
    threading.Thread(target=factory.run, args=(app(fleet, served), served, urls.append), daemon=True).start()

    def send_status() -> None:
        while not silent.wait(0.1):
            report(fleet, Status(speed=2.5))

    sender = threading.Thread(target=send_status)
    sender.start()
    until(lambda: urls)
    page.do("Page.navigate", url=urls[0])
    page.until("document.querySelector('[data-vehicle=car]')?.textContent === '9.0 km/h'")
    silent.set()
    sender.join()
    page.until("document.querySelector('[data-vehicle=car]').textContent === ''")
    assert (fleet.speeds()["car"]["reported_ms"] or 0) < 2000  # 0.3 s on a quiet machine
    report(fleet, Status())
    assert fleet.speeds() == {} and not page.errors
