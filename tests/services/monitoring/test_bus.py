"""Events reach programs by Kafka beyond ROS 2's network, and are processed once where both connect."""

from __future__ import annotations

from tests.fakes.broker import Broker
from tests.fakes.nodes import READY, end_well, wait_until_ready
from tests.fakes.ports import free_dds_domain
from tests.services.conftest import Start

PROGRAM = """
import sys, time
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import Body
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.monitoring.node.monitor import ros
from tests.fakes.nodes import spin_until_closed

class Count(Body):
    vehicles: int

ros.init()
node = ros.Node(sys.argv[1])
bus = Bus(node, BusParams(kafka_bootstrap_servers=sys.argv[2]))
bus.events.define("count", Count)
bus.events.on("count", lambda count: print(count.vehicles, flush=True))
bus.start()
sent = 0
def send():
    global sent
    bus.events.send("count", Count(vehicles=sent))
    sent += 1
if sys.argv[1] == "counts":
    node.create_timer(0.2, send)
spin_until_closed(ros, node)
bus.close()
node.destroy_node()
ros.shutdown()
"""
"""Node that prints the counts it receives; the node "counts" also sends them."""
ENOUGH = 6


def test_events_over_kafka_and_ros_are_processed_once(start: Start, broker: Broker) -> None:
    near = start("cyclone", "-c", PROGRAM, "near", broker.servers)
    far = start("cyclone", "-c", PROGRAM, "far", broker.servers, ROS_DOMAIN_ID=str(free_dds_domain()))
    counts = start("cyclone", "-c", PROGRAM, "counts", broker.servers)
    received: dict[str, list[int]] = {}
    for name, process in {"near": near, "far": far}.items():
        wait_until_ready(process)
        assert process.stdout
        received[name] = [int(process.stdout.readline()) for _ in range(ENOUGH)]
    (sent,) = end_well(counts)
    for found, rest in zip(received.values(), end_well(near, far), strict=True):
        found += map(int, rest.split())  # programs that start late miss earlier events
        assert len(set(found)) == len(found) and set(found) <= {int(one) for one in sent.split() if one != READY}
