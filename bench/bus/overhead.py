"""Overhead of monitoring for a publisher and a subscriber, plain and monitored (part `overhead` of `bench.bus`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from statistics import median

from bench.paths import ROOT
from tests.fakes.interpreters import ROS_PYTHON

LOADS = {"1kb": (1000, 1000.0, 5000), "6mb": (6_220_800, 30.0, 150)}
"""Message size in bytes, messages per second, number of messages."""
ROUNDS = 3
"""Pairs of a plain and a monitored run; the median of their ratios is reported."""
DOMAIN = "87"


def overhead() -> dict[str, float]:
    """Relative overhead of monitoring per transport: median latency, message rate, and CPU time of both ends.

    Keys are like `overhead_p50_1kb`, with the suffix `_cyclone` for cyclonedds. Both ends run
    on this machine.
    """
    found: dict[str, float] = {}
    for transport, python, suffix in (("rclpy", str(ROS_PYTHON), ""), ("cyclone", sys.executable, "_cyclone")):
        if not Path(python).exists():
            print(f"{transport}: skipped, {python} doesn't exist")
            continue
        for name, load in LOADS.items():
            ratios: dict[str, list[float]] = {"p50": [], "throughput": [], "cpu": []}
            for number in range(ROUNDS):
                pair = {kind: run(transport, python, kind, *load) for kind in _order(number)}
                for key, value in relative_overhead(pair["bare"], pair["watched"]).items():
                    ratios[key].append(value)
            for key, values in ratios.items():
                found[f"overhead_{key}_{name}{suffix}"] = round(median(values), 3)
            print(
                f"{transport} {name}: " + ", ".join(f"{key} {median(of):+.3f}" for key, of in ratios.items()),
                flush=True,
            )
    return found


def run(transport: str, python: str, kind: str, size: int, rate: float, count: int) -> dict[str, float]:
    """Run a pair of processes; the subscriber's results, and CPU milliseconds per message of both."""
    environment = os.environ | {"SCAN2SIM_TRANSPORT": transport, "ROS_DOMAIN_ID": DOMAIN, "PYTHONPATH": str(ROOT)}

    def start(role: str) -> subprocess.Popen[str]:
        command = [python, "-m", "bench.bus.overhead_node", role, kind, str(size), str(rate), str(count)]
        return subprocess.Popen(
            command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    subscriber, publisher = start("hear"), start("talk")
    results = [json.loads(process.communicate(timeout=300)[0].splitlines()[-1]) for process in (subscriber, publisher)]
    return results[0] | {"cpu_ms": results[0]["cpu_ms"] + results[1]["cpu_ms"]}


def relative_overhead(bare: Mapping[str, float], watched: Mapping[str, float]) -> dict[str, float]:
    """Relative overhead of the monitored pair; larger is worse."""
    return {
        "p50": watched["p50_ms"] / bare["p50_ms"] - 1,
        "throughput": 1 - watched["per_second"] / bare["per_second"],
        "cpu": watched["cpu_ms"] / bare["cpu_ms"] - 1,
    }


def _order(number: int) -> tuple[str, str]:
    return ("bare", "watched") if number % 2 == 0 else ("watched", "bare")


if __name__ == "__main__":
    print("RESULT " + json.dumps(overhead()))
