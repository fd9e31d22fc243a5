"""API and page of fleet management: what an operator sees and does."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
from fastapi.testclient import TestClient

from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.identity import Peer, Role
from scan2sim.services.teleoperation.gateway.protocol import Hello, LinkStatus, Status
from scan2sim.services.teleoperation.gateway.web import application
from tests.fakes.browser import chromium

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
    status = Status(links=links, speed=2.5, age=48.0, told=HOSTILE)
    fleet.update_status(Peer(Role.VEHICLE, "car", "0" * 64), status)
    return fleet


def app(fleet: Fleet, served: ServerParams | None = None) -> Any:
    return application(served or ServerParams(), fleet, FakeGateway())  # type: ignore[arg-type]


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


def test_page_lists_parties_and_joins_them(tmp_path: Path) -> None:
    fleet, urls = fleet_with_parties(tmp_path), list[str]()
    served = ServerParams(port=0)
    threading.Thread(target=factory.run, args=(app(fleet, served), served, urls.append), daemon=True).start()
    end = time.monotonic() + 20
    while not urls and time.monotonic() < end:
        time.sleep(0.02)
    with chromium(tmp_path) as page:
        page.do("Page.navigate", url=urls[0])
        page.until("document.querySelectorAll('#vehicles .run').length === 2")
        page.click("#vehicles .run button")
        page.until("document.querySelector('#vehicles').textContent.includes('driven from desk')")
        text = page.value("document.body.innerText")
        assert "84 ms 1.0 % lost" in text and "wifi down" in text and HOSTILE in text and "9.0 km/h" in text
        assert page.value("document.title") == "Fleet · scan2sim" and not page.errors
    assert fleet.snapshot()["vehicles"][0]["other"] == "desk"
