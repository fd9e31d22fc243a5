"""An OSM to try things on: the stand-in, and a deployment for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from scan2sim.services.orchestration import lifecycle
from scan2sim.services.orchestration import osm as osm_client
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection
from tests.fakes.osm import Fake, State

TOWN = """
deployment = "town"
[[service]]
name = "detect-north"
service = "detect"
cluster = "edge-cluster"
replicas = 2
[[service]]
name = "segment-south"
service = "segment"
kind = "machine"
vim = "edge-site"
replicas = 2
"""


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits of seconds take hundredths here."""
    monkeypatch.setenv("OSM_PASSWORD", "admin")
    for module, name in ((lifecycle, "POLL"), (osm_client, "PAUSE")):
        monkeypatch.setattr(module, name, 0.01)


@pytest.fixture
def fake() -> Iterator[Fake]:
    with Fake(State(seconds=0.02)) as made:
        yield made


@pytest.fixture
def osm(fake: Fake) -> Iterator[Osm]:
    with Osm(Connection(osm=fake.address)) as made:
        yield made


@pytest.fixture
def town(tmp_path: Path) -> Path:
    path = tmp_path / "services.toml"
    path.write_text(TOWN, encoding="utf-8")
    return path
