"""A hundred nodes on one machine, watched by one page (part `nodes` of `bench.bus`).

Ten processes have ten nodes each, as every process costs a participant on DDS. Each node publishes at its own rate,
and its records go to a real broker; the page is a real one, and what it shows is asked of its API.
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

PROCESSES, EACH = 10, 10
SIZE = 1000
"""Bytes of a message, with what CDR adds."""
SETTLED, WATCHED = 20.0, 30.0
"""Seconds until all have joined, at least, and over which the page is asked for then."""
CORRECT = 0.05
"""Share by which a node's bandwidth may be off, in the median second."""
DOMAIN = "86"


def rate(number: int) -> float:
    """Messages a second of a node: 5 to 14."""
    return 5.0 + number % 10


def nodes_watched() -> dict[str, float]:
    """How many nodes the page shows at their rates.

    Returns:
        nodes_watched: of 100; nodes_page_cpu and nodes_cpu: processors that the page and all nodes keep busy.
    """
    broker = Broker()
    broker.start()
    with tempfile.TemporaryDirectory() as state:
        environment = os.environ | {
            "ROS_DOMAIN_ID": DOMAIN, "SCAN2SIM_TRANSPORT": "cyclone", "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": state,
        }  # fmt: skip
        shown: subprocess.Popen[str] = subprocess.Popen(
            [sys.executable, "-m", "scan2sim.flows.cli", "monitor", "page", "--kafka", broker.servers, "--port", "0"],
            env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        makers = [
            subprocess.Popen(
                [sys.executable, "-m", "bench.bus.many_nodes", str(process), broker.servers], env=environment, cwd=ROOT
            )
            for process in range(PROCESSES)
        ]
        try:
            assert shown.stdout
            address = shown.stdout.readline().split()[0]
            found = _watched(address, shown.pid, [one.pid for one in makers])
        finally:
            running: list[subprocess.Popen[Any]] = [shown, *makers]
            for one in running:
                one.terminate()
            for one in running:
                one.wait(60)
            broker.kill()
    return found


def _watched(address: str, page: int, makers: list[int]) -> dict[str, float]:
    began, count = time.monotonic(), PROCESSES * EACH
    while time.monotonic() < began + SETTLED or len(_window(address)["nodes"]) < count:
        time.sleep(1.0)
        if time.monotonic() > began + 10 * SETTLED:
            break
    before = [_cpu(one) for one in (page, *makers)]
    with urllib.request.urlopen(f"{address}api/live?seconds=300", timeout=30) as live:  # as a browser has it open
        end = time.monotonic() + WATCHED
        while time.monotonic() < end:
            live.readline()
    spent = [(_cpu(one) - then) / WATCHED for one, then in zip((page, *makers), before, strict=True)]
    right = 0
    for node in _window(address, WATCHED)["nodes"]:
        asked = SIZE * rate(int(node["name"].rpartition("_")[2]))
        told = [one for one in node["bandwidth"]["mean"] if one is not None]
        right += bool(told) and abs(median(told) / asked - 1) < CORRECT
    print(f"{right} of {count} nodes in {PROCESSES} processes; processors: page {spent[0]:.2f}, all {sum(spent):.2f}")
    return {
        "nodes_watched": right,
        "nodes_page_cpu": round(spent[0], 3),
        "nodes_cpu": round(sum(spent[1:]), 2),
        "nodes_processes": PROCESSES,
    }


def _window(address: str, seconds: float = 10.0) -> dict[str, Any]:
    """Of the page's API; the last two seconds are left out, as records are still to come."""
    end = time.time() - 2
    query = urllib.parse.urlencode({"from": end - seconds, "to": end})
    with urllib.request.urlopen(f"{address}api/history?{query}", timeout=30) as answer:
        told: dict[str, Any] = json.load(answer)
        return told


def _cpu(process: int) -> float:
    times = psutil.Process(process).cpu_times()
    return float(times.user + times.system)


def _make(process: int, servers: str) -> None:
    """Nodes of one process."""
    from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros

    text = ros.message(STRING, data="x" * (SIZE - 9))  # 4 of encapsulation, 4 of length, 1 that ends it
    ros.init()
    numbers = range(process * EACH, (process + 1) * EACH)
    nodes = [Monitor(f"node_{number}", kafka_bootstrap_servers=servers) for number in numbers]
    publishers = [
        node.create_publisher(ros.message_type(STRING), f"topic_{number}", 10)
        for number, node in zip(numbers, nodes, strict=True)
    ]
    sent, began = [0] * EACH, time.monotonic()
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
        _make(int(sys.argv[1]), sys.argv[2])
    else:
        print("RESULT " + json.dumps(nodes_watched()))
