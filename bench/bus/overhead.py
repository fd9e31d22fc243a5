"""What watching costs: a publisher and a subscriber, bare and watched, in turn (part `overhead` of `bench.bus`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from statistics import median

from bench.paths import ROOT

ROS_PYTHON = ROOT / ".venv-ros" / "bin" / "python"
LOADS = {"1kb": (1000, 1000.0, 5000), "6mb": (6_220_800, 30.0, 150)}
"""Bytes, messages a second, messages."""
TURNS = 3
"""Pairs of a bare and a watched run; medians of their ratios count."""
DOMAIN = "87"


def overhead() -> dict[str, float]:
    """Watched by bare, for each transport that is here: p50 of latency, rate, CPU time of both ends; less 1.

    Keys as `overhead_p50_1kb`; those of cyclonedds end with `_cyclone`. Both ends are
    on one machine.
    """
    found: dict[str, float] = {}
    for transport, python, suffix in (("rclpy", str(ROS_PYTHON), ""), ("cyclone", sys.executable, "_cyclone")):
        if not Path(python).exists():
            print(f"{transport}: left out, there is no {python}")
            continue
        for name, load in LOADS.items():
            ratios: dict[str, list[float]] = {"p50": [], "throughput": [], "cpu": []}
            for turn in range(TURNS):
                pair = {kind: run(transport, python, kind, *load) for kind in _order(turn)}
                for key, value in compared(pair["bare"], pair["watched"]).items():
                    ratios[key].append(value)
            for key, values in ratios.items():
                found[f"overhead_{key}_{name}{suffix}"] = round(median(values), 3)
            print(
                f"{transport} {name}: " + ", ".join(f"{key} {median(of):+.3f}" for key, of in ratios.items()),
                flush=True,
            )
    return found


def run(transport: str, python: str, kind: str, size: int, rate: float, count: int) -> dict[str, float]:
    """One pair of processes: the subscriber's figures, and CPU milliseconds a message of both."""
    environment = os.environ | {"SCAN2SIM_TRANSPORT": transport, "ROS_DOMAIN_ID": DOMAIN, "PYTHONPATH": str(ROOT)}

    def started(role: str) -> subprocess.Popen[str]:
        command = [python, "-m", "bench.bus.overhead_node", role, kind, str(size), str(rate), str(count)]
        return subprocess.Popen(
            command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    hears, talks = started("hear"), started("talk")
    told = [json.loads(process.communicate(timeout=300)[0].splitlines()[-1]) for process in (hears, talks)]
    return told[0] | {"cpu_ms": told[0]["cpu_ms"] + told[1]["cpu_ms"]}


def compared(bare: Mapping[str, float], watched: Mapping[str, float]) -> dict[str, float]:
    """By how much the watched pair is slower: shares of the bare one's figures; more is worse."""
    return {
        "p50": watched["p50_ms"] / bare["p50_ms"] - 1,
        "throughput": 1 - watched["per_second"] / bare["per_second"],
        "cpu": watched["cpu_ms"] / bare["cpu_ms"] - 1,
    }


def _order(turn: int) -> tuple[str, str]:
    return ("bare", "watched") if turn % 2 == 0 else ("watched", "bare")


if __name__ == "__main__":
    print("RESULT " + json.dumps(overhead()))
