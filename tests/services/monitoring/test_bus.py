"""Events cross by Kafka where ROS 2 doesn't reach, and are acted on once where both do."""

from __future__ import annotations

import json
import subprocess

from tests.fakes.broker import Broker
from tests.fakes.ports import free_dds_domain
from tests.services.conftest import Start

PROGRAM = """
import sys, time
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import Body
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.monitoring.node.monitor import ros

class Count(Body):
    vehicles: int

ros.init()
node = ros.Node(sys.argv[1])
bus = Bus(node, BusParams(kafka_bootstrap_servers=sys.argv[2]))
bus.events.define("count", Count)
taken = []
bus.events.on("count", lambda count: taken.append(count.vehicles))
end, told = time.monotonic() + 16, 0
while time.monotonic() < end:
    ros.spin_once(node, 0.1)
    if sys.argv[1] == "counts" and time.monotonic() > end - 16 + 0.2 * told:
        bus.events.send("count", Count(vehicles=told))
        told += 1
bus.close()
node.destroy_node()
ros.shutdown()
print(taken)
"""


def test_events_are_taken_once_by_kafka_and_ros(start: Start, broker: Broker) -> None:
    counts = start("cyclone", "-c", PROGRAM, "counts", broker.servers)
    near = start("cyclone", "-c", PROGRAM, "near", broker.servers)
    far = start("cyclone", "-c", PROGRAM, "far", broker.servers, ROS_DOMAIN_ID=str(free_dds_domain()))

    def taken(process: subprocess.Popen[str]) -> list[int]:
        output, errors = process.communicate(timeout=90)
        assert process.returncode == 0, errors
        return json.loads(output)

    sent = taken(counts)
    for received in (taken(near), taken(far)):  # who joins late misses what was sent before
        assert len(received) > 5 and len(set(received)) == len(received) and set(received) <= set(sent)
