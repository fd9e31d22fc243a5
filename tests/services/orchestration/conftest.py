"""Fixtures: a fake OSM, a client of it, and a deployment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from scan2sim.services.orchestration import lifecycle
from scan2sim.services.orchestration import osm as osm_client
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection
from tests.fakes.osm import FakeOsm, OsmState

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
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten waits of seconds to hundredths."""
    monkeypatch.setenv("OSM_PASSWORD", "admin")
    for module, name in ((lifecycle, "POLL_INTERVAL_S"), (osm_client, "RETRY_DELAY_S")):
        monkeypatch.setattr(module, name, 0.01)


@pytest.fixture
def fake() -> Iterator[FakeOsm]:
    with FakeOsm(OsmState(seconds=0.02)) as made:
        yield made


@pytest.fixture
def osm(fake: FakeOsm) -> Iterator[Osm]:
    with Osm(Connection(osm=fake.address)) as made:
        yield made


@pytest.fixture
def town(tmp_path: Path) -> Path:
    path = tmp_path / "services.toml"
    path.write_text(TOWN, encoding="utf-8")
    return path
