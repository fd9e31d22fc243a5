"""Events reach programs by Kafka beyond ROS 2's network, and are processed once where both connect."""

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
received = []
bus.events.on("count", lambda count: received.append(count.vehicles))
end, sent = time.monotonic() + 16, 0
while time.monotonic() < end:
    ros.spin_once(node, 0.1)
    if sys.argv[1] == "counts" and time.monotonic() > end - 16 + 0.2 * sent:
        bus.events.send("count", Count(vehicles=sent))
        sent += 1
bus.close()
node.destroy_node()
ros.shutdown()
print(received)
"""


def test_events_over_kafka_and_ros_are_processed_once(start: Start, broker: Broker) -> None:
    counts = start("cyclone", "-c", PROGRAM, "counts", broker.servers)
    near = start("cyclone", "-c", PROGRAM, "near", broker.servers)
    far = start("cyclone", "-c", PROGRAM, "far", broker.servers, ROS_DOMAIN_ID=str(free_dds_domain()))

    def received_by(process: subprocess.Popen[str]) -> list[int]:
        output, errors = process.communicate(timeout=90)
        assert process.returncode == 0, errors
        return json.loads(output)

    sent = received_by(counts)
    for received in (received_by(near), received_by(far)):  # programs that start late miss earlier events
        assert len(received) > 5 and len(set(received)) == len(received) and set(received) <= set(sent)
