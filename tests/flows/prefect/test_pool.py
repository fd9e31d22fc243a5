"""`monitor pool` starts and stops workers of a Prefect pool as requested on the bus; they end with the command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.conftest import ROOT
from tests.flows.prefect.conftest import Server, on
from tests.flows.processes import processes
from tests.waiting import until

MARK = "SCAN2SIM_TEST_POOL"
ASK = """
import os, sys, threading
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import WorkersWanted
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.monitoring.node.monitor import ros
ros.init()
node = ros.Node("asks")
bus = Bus(node, BusParams())
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0))).start()
while True:
    bus.events.send("workers", WorkersWanted(queue="elastic", workers=int(sys.argv[1]), rate=0, waiting=0))
    ros.spin_once(node, 0.5)
"""


@pytest.mark.slow
@on("sqlite")
def test_pool_starts_and_stops_workers_on_request(server: Server) -> None:
    pytest.importorskip("cyclonedds", reason="cyclonedds isn't installed")
    server.api("POST", "/work_pools/", {"name": "elastic", "type": "process"})
    environment = server.env | {"PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": "103", MARK: "1"}
    environment["SCAN2SIM_TRANSPORT"] = "cyclone"

    def online() -> int:
        found = server.api("POST", "/work_pools/elastic/workers/filter", {})
        return sum(one["status"] == "ONLINE" for one in found)

    def running() -> int:
        return len(processes(MARK, "1"))

    @contextmanager
    def asking(count: int) -> Iterator[None]:
        env = {name: value for name, value in environment.items() if name != MARK}
        with subprocess.Popen([sys.executable, "-c", ASK, str(count)], env=env, stdin=subprocess.PIPE) as process:
            yield
            assert process.poll() is None
            process.communicate()

    command = [sys.executable, "-m", "scan2sim.flows.cli", "monitor", "pool", "elastic", "--max-workers", "2"]
    with subprocess.Popen(command, env=environment) as pool:
        try:
            three = "the minimum: the command, a guard process and a worker"
            until(lambda: online() == 1 and running() == 3, 120, what=three)
            with asking(9):
                until(lambda: online() == 2 and running() == 5, 120, what="not more than the maximum")
            with asking(0):
                until(lambda: running() == 3, 120, what="not fewer than the minimum")
        finally:
            pool.kill()
    until(lambda: not processes(MARK, "1"), 60, what="the end of all processes")
