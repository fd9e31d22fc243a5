"""Named operators of the fleet page: roles, revocation, and their names in the audit trail."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
from fastapi.testclient import TestClient

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access import drivers
from scan2sim.services.teleoperation.access.drivers import DriverRole, Drivers
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.web import application, serve
from scan2sim.services.teleoperation.gateway_protocol import Hello
from scan2sim.services.teleoperation.identity import Peer, Role
from scan2sim.services.teleoperation.settings import GatewayParams
from tests.fakes.browser import chromium
from tests.waiting import until


class FakeGateway:
    def alive(self) -> bool:
        return True


class Service:
    """A gateway's page with an observer and an operator; `orders` are those of the vehicle car."""

    def __init__(self, folder: Path) -> None:
        self.file, self.orders = folder / "drivers.json", list[Order]()
        self.tokens = {role: drivers.add(self.file, f"the-{role}", role) for role in DriverRole}
        self.fleet = Fleet(folder / "state")
        self.fleet.connected(Peer(Role.VEHICLE, "car", "0" * 64), Hello(), "10.0.0.1:5", self.orders.append)
        self.fleet.connected(Peer(Role.STATION, "desk", "0" * 64), Hello(), "10.0.0.2:5", list[Order]().append)
        self.served = ServerParams(port=0)
        self.app = application(self.served, self.fleet, FakeGateway(), Drivers(self.file))  # type: ignore[arg-type]

    def client(self, role: DriverRole) -> TestClient:
        headers = {"Authorization": f"Bearer {self.tokens[role]}"}
        return TestClient(self.app, base_url="http://localhost", headers=headers)


def test_only_operators_change_the_fleet_and_the_trail_names_them(tmp_path: Path) -> None:
    service = Service(tmp_path)
    operator = service.client(DriverRole.OPERATOR)
    for role in (DriverRole.OBSERVER, DriverRole.DRIVER):
        client = service.client(role)
        assert client.get("/api/fleet").json()["you"] == {"name": f"the-{role}", "role": role}
        for action in ("join", "hand-over", "take-back", "release"):
            refused = client.post(f"/api/vehicles/car/{action}", json={"station": "desk"})
            assert refused.status_code == 403
            assert f"the-{role}: has the role {role}; this requires operator" in refused.json()["error"]
    assert not service.fleet.audit.newest, "nothing was done"
    assert operator.post("/api/vehicles/car/join", json={"station": "desk"}).json() == {"pair": 1}
    assert operator.post("/api/vehicles/car/release").status_code == 200
    assert [(one["what"], one["by"]) for one in operator.get("/api/audit").json()] == [
        ("release", "the-operator at fleet management"),
        ("join", "the-operator at fleet management"),
    ]
    assert "the-operator at fleet management released car" in str(service.orders[-1]), "the vehicle learns who did it"


def test_revoked_operator_is_rejected_at_once(tmp_path: Path) -> None:
    service = Service(tmp_path)
    operator, stranger = service.client(DriverRole.OPERATOR), TestClient(service.app, base_url="http://localhost")
    assert operator.get("/api/fleet").status_code == 200
    drivers.revoke(service.file, "the-operator")
    for client in (operator, stranger):
        assert client.post("/api/vehicles/car/join", json={"station": "desk"}).status_code == 401
        assert client.get("/api/fleet").status_code == client.get("/api/audit").status_code == 401
    service.file.write_text("[", encoding="utf-8")
    assert service.client(DriverRole.DRIVER).get("/api/fleet").status_code == 401, "a damaged file lets nobody in"
    assert operator.get("/health/live").status_code == 200 and not service.fleet.audit.newest


def test_gateway_beyond_the_loopback_accepts_drivers_as_protection_and_refuses_a_wrong_file(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--drivers FILE, --token FILE, or --certificate and --key"):
        GatewayParams(certificates=tmp_path, host="0.0.0.0")
    params = GatewayParams(certificates=tmp_path, host="0.0.0.0", drivers=tmp_path / "drivers.json")
    assert not params.is_open()
    with pytest.raises(InputError, match="teleop drivers FILE --add"):
        serve(params, lambda text: None)


def test_page_shows_actions_to_operators_only_and_nothing_after_revocation(tmp_path: Path) -> None:
    service, urls = Service(tmp_path), list[str]()
    threading.Thread(target=factory.run, args=(service.app, service.served, urls.append), daemon=True).start()
    until(lambda: urls)
    with chromium(tmp_path / "browser") as page:

        def sign_in(token: str) -> None:
            page.do("Page.navigate", url=urls[0])
            page.until("document.querySelector('#token')?.hidden === false")
            page.value(f"document.querySelector('#token input').value = ' {token} '")
            page.click("#token button")

        sign_in("wrong-token-of-nobody")
        page.until("document.querySelector('#status').textContent === 'the token is wrong or no longer valid'")
        sign_in(service.tokens[DriverRole.OBSERVER])
        page.until("document.querySelector('#you').textContent === 'the-observer, observer'")
        page.until("document.querySelectorAll('#vehicles .run').length === 1")
        assert page.value("document.querySelectorAll('#vehicles button').length") == 0
        page.value("sessionStorage.clear()")
        sign_in(service.tokens[DriverRole.OPERATOR])
        page.until("document.querySelectorAll('#vehicles button').length === 1")
        page.click("#vehicles button")
        page.until("document.querySelector('#audit').textContent.includes('the-operator at fleet management')")
        drivers.revoke(service.file, "the-operator")
        page.until("document.querySelector('#vehicles').textContent === ''")
        assert page.value("document.querySelector('#audit').textContent") == ""
        assert [one for one in page.errors if "401" not in one] == []
