"""A hundred nodes on one machine, monitored by one page (part `nodes` of `bench.bus`).

Ten processes run ten nodes each, as every process costs a DDS participant. Each node publishes at its own rate and
sends its records to a real broker; the page is real, and its API is queried for what it shows.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from statistics import median
from typing import Any

import psutil

from bench.paths import ROOT
from tests.fakes.broker import Broker

PROCESSES, NODES_PER_PROCESS = 10, 10
MESSAGE_BYTES = 1000
"""Size of a message, including CDR serialization."""
SETTLE_S, MEASURE_S = 20.0, 30.0
"""Minimum time until all nodes have joined, and duration of the measurement."""
MAX_BANDWIDTH_ERROR = 0.05
"""Maximum relative error of a node's bandwidth, in the median second."""
DOMAIN = "86"


def rate(number: int) -> float:
    """Messages per second of a node: 5 to 14."""
    return 5.0 + number % 10


def nodes_watched() -> dict[str, float]:
    """Number of nodes that the page shows with the right rate.

    Returns:
        nodes_watched: of 100; nodes_page_cpu and nodes_cpu: CPU cores used by the page and by all nodes.
    """
    broker = Broker()
    broker.start()
    with tempfile.TemporaryDirectory() as state:
        environment = os.environ | {
            "ROS_DOMAIN_ID": DOMAIN, "SCAN2SIM_TRANSPORT": "cyclone", "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": state,
        }  # fmt: skip
        page: subprocess.Popen[str] = subprocess.Popen(
            [sys.executable, "-m", "scan2sim.flows.cli", "monitor", "page", "--kafka", broker.servers, "--port", "0"],
            env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        node_processes = [
            subprocess.Popen(
                [sys.executable, "-m", "bench.bus.many_nodes", str(process), broker.servers], env=environment, cwd=ROOT
            )
            for process in range(PROCESSES)
        ]
        try:
            assert page.stdout
            address = page.stdout.readline().split()[0]
            found = _measure(address, page.pid, [one.pid for one in node_processes])
        finally:
            running: list[subprocess.Popen[Any]] = [page, *node_processes]
            for one in running:
                one.terminate()
            for one in running:
                one.wait(60)
            broker.kill()
    return found


def _measure(address: str, page: int, node_processes: list[int]) -> dict[str, float]:
    began, count = time.monotonic(), PROCESSES * NODES_PER_PROCESS
    while time.monotonic() < began + SETTLE_S or len(_window(address)["nodes"]) < count:
        time.sleep(1.0)
        if time.monotonic() > began + 10 * SETTLE_S:
            break
    before = [_cpu(one) for one in (page, *node_processes)]
    with urllib.request.urlopen(f"{address}api/live?seconds=300", timeout=30) as live:  # like an open browser
        end = time.monotonic() + MEASURE_S
        while time.monotonic() < end:
            live.readline()
    cores = [(_cpu(one) - then) / MEASURE_S for one, then in zip((page, *node_processes), before, strict=True)]
    right = 0
    for node in _window(address, MEASURE_S)["nodes"]:
        true_rate = MESSAGE_BYTES * rate(int(node["name"].rpartition("_")[2]))
        shown = [one for one in node["bandwidth"]["mean"] if one is not None]
        right += bool(shown) and abs(median(shown) / true_rate - 1) < MAX_BANDWIDTH_ERROR
    print(f"{right} of {count} nodes in {PROCESSES} processes; CPU cores: page {cores[0]:.2f}, all {sum(cores):.2f}")
    return {
        "nodes_watched": right,
        "nodes_page_cpu": round(cores[0], 3),
        "nodes_cpu": round(sum(cores[1:]), 2),
        "nodes_processes": PROCESSES,
    }


def _window(address: str, seconds: float = 10.0) -> dict[str, Any]:
    """History of the page's API, without the last two seconds, whose records may still arrive."""
    end = time.time() - 2
    query = urllib.parse.urlencode({"from": end - seconds, "to": end})
    with urllib.request.urlopen(f"{address}api/history?{query}", timeout=30) as answer:
        history: dict[str, Any] = json.load(answer)
        return history


def _cpu(process: int) -> float:
    times = psutil.Process(process).cpu_times()
    return float(times.user + times.system)


def _run_nodes(process: int, servers: str) -> None:
    """Run the nodes of one process."""
    from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros

    text = ros.message(STRING, data="x" * (MESSAGE_BYTES - 9))  # 4 bytes of encapsulation, 4 of length, 1 terminator
    ros.init()
    numbers = range(process * NODES_PER_PROCESS, (process + 1) * NODES_PER_PROCESS)
    nodes = [Monitor(f"node_{number}", kafka_bootstrap_servers=servers) for number in numbers]
    publishers = [
        node.create_publisher(ros.message_type(STRING), f"topic_{number}", 10)
        for number, node in zip(numbers, nodes, strict=True)
    ]
    sent, began = [0] * NODES_PER_PROCESS, time.monotonic()
    try:
        while True:
            time.sleep(0.01)
            for one, number in enumerate(numbers):
                while sent[one] < rate(number) * (time.monotonic() - began):
                    publishers[one].publish(text)
                    sent[one] += 1
    except KeyboardInterrupt:
        for node in nodes:
            node.destroy_node()
        ros.shutdown()


if __name__ == "__main__":
    if len(sys.argv) == 3:
        import signal

        signal.signal(signal.SIGTERM, signal.default_int_handler)
        _run_nodes(int(sys.argv[1]), sys.argv[2])
    else:
        print("RESULT " + json.dumps(nodes_watched()))
