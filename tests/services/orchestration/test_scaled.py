"""An instance in OSM is scaled according to queue load."""

from __future__ import annotations

from scan2sim.services.monitoring.autoscale.actuators.osm import OsmReplicas
from scan2sim.services.orchestration import description, operations
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.package import build
from scan2sim.services.orchestration.settings import Connection
from scan2sim.services.qos.requirements import Environment
from tests.fakes.osm import FakeOsm
from tests.waiting import until


def test_replicas_are_scaled_to_the_last_requested_count(fake: FakeOsm, osm: Osm) -> None:
    made = build(description.read("worker"), Environment.EDGE, "container")
    operations.onboard(osm, [made.function, made.service])
    site, wait_policy = osm.cluster("edge-cluster"), WaitPolicy(60)
    nsd = made.service.descriptor.id
    operations.instantiate(osm, "workers", nsd, site, wait_policy=wait_policy, notify=lambda text: None)
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
