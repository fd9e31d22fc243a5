"""Whatever a server answers, the client ends with a message, in bounded time, and never with a traceback."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration import lifecycle, onboarding
from scan2sim.services.orchestration import osm as osm_client
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection
from tests.fakes import odd_answers
from tests.fakes.osm import FakeOsm, OsmState
from tests.services.orchestration.conftest import TOWN

NEW = '[[service]]\nname = "classify-west"\nservice = "classify"\ncluster = "edge-cluster"\n'


def outcomes(osm: Osm, town: Path) -> list[str]:
    """Messages of the operations that failed."""
    found = []
    for call in odd_answers.calls(osm, town, "detect-north", "segment-south").values():
        try:
            call()
        except ScanError as error:
            assert error.cause and error.remedy and str(error).isprintable()
            found.append(str(error))
    return found


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What an OSM stores in which the town runs, with one upgrade and one scaling done."""
    town = tmp_path_factory.mktemp("town") / "services.toml"
    with pytest.MonkeyPatch.context() as patch, FakeOsm(OsmState(seconds=0.01)) as fake:
        patch.setenv("OSM_PASSWORD", "admin")
        patch.setattr(lifecycle, "POLL_INTERVAL_S", 0.01)
        for text in (TOWN.replace("replicas = 2", "replicas = 1"), TOWN):
            town.write_text(text, encoding="utf-8")
            with Osm(Connection(osm=fake.address)) as osm:
                odd_answers.calls(osm, town, "", "")["apply"]()
        return odd_answers.stored(fake.state)


@pytest.mark.parametrize("kind", odd_answers.KINDS)
def test_odd_answers_end_in_a_message(
    fake: FakeOsm, town: Path, kind: str, running: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, name, value in (
        (osm_client, "RETRY_DELAY_S", 0.001),
        (osm_client, "MAX_ATTEMPTS", 2),
        (osm_client, "MAX_RESPONSE_BYTES", 2**20),
        (lifecycle, "MAX_LOST_RESPONSES", 1),
        (onboarding, "MAX_LOST_RESPONSES", 1),
    ):
        monkeypatch.setattr(module, name, value)
    vars(fake.state).update(copy.deepcopy(running))
    town.write_text(TOWN + NEW, encoding="utf-8")
    fake.state.answer = odd_answers.KINDS[kind]
    with Osm(Connection(osm=fake.address)) as osm:
        found = outcomes(osm, town)
    assert found or kind in odd_answers.HARMLESS
    assert "pw@" not in str(found)
