"""The web page in a real browser: upload, onboard, instantiate and delete a service."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services.http import factory
from scan2sim.services.orchestration import description
from scan2sim.services.orchestration.catalogue import Catalogue
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.page import application
from scan2sim.services.orchestration.settings import PageParams
from scan2sim.services.qos.requirements import Environment
from tests.fakes.browser import Page, chromium
from tests.fakes.osm import FakeOsm

ONBOARDED = "[...document.querySelectorAll('#services article')].some(one => !one.textContent.includes('not in OSM'))"


@dataclass
class Served:
    """A served page."""

    url: str
    folder: Path

    def request(self, method: str, path: str, body: bytes = b"", **headers: str) -> Any:
        request = urllib.request.Request(self.url + path, body or None, headers, method=method)
        with urllib.request.urlopen(request, timeout=20) as answer:
            return json.loads(answer.read())

    def error(self, method: str, path: str, body: bytes = b"") -> tuple[int, str]:
        with pytest.raises(urllib.error.HTTPError) as caught:
            self.request(method, path, body)
        return caught.value.code, json.loads(caught.value.read())["cause"]


@pytest.fixture
def made() -> Packages:
    return build(description.read("detect"), Environment.EDGE, "container")


@pytest.fixture
def served(fake: FakeOsm, osm: Osm, tmp_path: Path) -> Iterator[Served]:
    params = PageParams(osm=fake.address, packages=tmp_path / "packages", cluster="edge-cluster", port=0)
    catalogue, addresses = Catalogue(osm, params.packages, lambda osm: osm.cluster("edge-cluster")), list[str]()
    listening = threading.Event()

    def notify(address: str) -> None:
        addresses.append(address)
        listening.set()

    app = application(params, catalogue)
    threading.Thread(target=factory.run, args=(app, params, notify), daemon=True).start()
    assert listening.wait(20)
    yield Served(addresses[0].rstrip("/"), params.packages)
    catalogue.close()


def press_button(page: Page, name: str) -> None:
    button = f"[...document.querySelectorAll('#services button')].find(b => b.textContent === '{name}')"
    page.until(f"(b => b && !b.disabled && (b.click(), true))({button})")  # at once: the page replaces its buttons


def test_a_service_can_be_uploaded_onboarded_started_and_removed(
    served: Served, fake: FakeOsm, made: Packages, tmp_path: Path
) -> None:
    files = [str(one.save(tmp_path)) for one in (made.service, made.function)]
    fake.state.seconds = 1.0
    with chromium(tmp_path, "--disable-gpu") as page:
        page.do("Page.navigate", url=served.url)
        page.until("document.getElementById('status')?.textContent === 'live'")
        assert page.value("!document.getElementById('empty').hidden")
        page.value("window.prompt = () => 'robot-1'; window.confirm = () => true; 1")
        root = page.do("DOM.getDocument")["root"]["nodeId"]
        chosen = page.do("DOM.querySelector", nodeId=root, selector="input[type=file]")["nodeId"]
        page.do("DOM.setFileInputFiles", nodeId=chosen, files=files)
        page.click("#upload button")
        page.until("document.querySelectorAll('#services article').length === 1")
        press_button(page, "Onboard")
        page.until(
            "[...document.querySelectorAll('#services article')].some(a => !a.textContent.includes('not in OSM'))"
        )
        press_button(page, "Instantiate")
        page.until("document.querySelector('#services .pill')?.textContent === 'robot-1 ready'")
        press_button(page, "Delete")
        page.until("!document.querySelector('#services .pill')")
        page.until("document.getElementById('services').textContent.includes('not in OSM')")
        assert page.errors == []
    assert not fake.state.instances and not fake.state.functions and not fake.state.resources


def test_failures_are_shown_beside_the_service(served: Served, fake: FakeOsm, made: Packages, tmp_path: Path) -> None:
    for one in (made.service, made.function):
        served.request("PUT", "/api/packages", one.data)
    service = made.service.descriptor.id
    fake.state.outcome = lambda kind, name: "FAILED"
    with chromium(tmp_path, "--disable-gpu") as page:
        page.do("Page.navigate", url=served.url)
        served.request("POST", f"/api/services/{service}/onboard")
        page.until(
            "[...document.querySelectorAll('#services article')].some(a => !a.textContent.includes('not in OSM'))"
        )
        name = json.dumps({"name": "robot-1"}).encode()
        served.request("POST", f"/api/services/{service}/instantiate", name, **{"Content-Type": "application/json"})
        page.until("document.querySelector('#services .failure')?.textContent.includes('no quota')")


def test_invalid_uploads_and_requests_are_rejected(served: Served, made: Packages) -> None:
    assert served.error("PUT", "/api/packages", b"rubbish")[0] == 422
    assert served.error("PUT", "/api/packages", bytes(9 * 2**20))[0] == 413
    assert served.error("POST", "/api/services/none/onboard") == (422, "unknown service")
    served.request("PUT", "/api/packages", made.service.data)
    service = made.service.descriptor.id
    assert served.request("GET", "/api/services")["services"][0]["missing"] == [made.function.descriptor.id]
    assert served.error("POST", f"/api/services/{service}/instantiate", b'{"name": "../x"}')[0] == 422
    assert [path.name for path in served.folder.iterdir()] == [f"{service}_nsd.tar.gz"]
