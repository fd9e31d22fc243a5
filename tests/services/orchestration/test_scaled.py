"""An instance in OSM is scaled as the event bus asks."""

from __future__ import annotations

import time
from collections.abc import Callable

from scan2sim.services.monitoring.autoscale.actuators.osm import OsmReplicas
from scan2sim.services.orchestration import description, operations
from scan2sim.services.orchestration.lifecycle import Patience
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.package import build
from scan2sim.services.orchestration.settings import Connection
from scan2sim.services.qos.requirements import Environment
from tests.fakes.osm import Fake


def until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not done():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_replicas_follow_what_is_asked_for_the_last_one_counting(fake: Fake, osm: Osm) -> None:
    made = build(description.read("worker"), Environment.EDGE, "container")
    operations.onboard(osm, [made.function, made.service])
    site, patience = osm.cluster("edge-cluster"), Patience(10)
    nsd = made.service.descriptor.id
    operations.instantiate(osm, "workers", nsd, site, patience=patience, say=lambda text: None)
    workers = OsmReplicas(Connection(osm=fake.address), "workers")
    try:
        for count in (2, 3, 5):
            workers.scale(count)
        until(lambda: workers.workers() == 5)
        last = list(fake.state.operations.values())[-1]
        assert last["operationParams"]["primitive_params"]["replicaCount"] == 5
        workers.scale(1)
        until(lambda: workers.workers() == 1)
    finally:
        workers.close()
    assert [one["nsState"] for one in fake.state.instances.values()] == ["READY"]
