"""Orchestration of services with OSM: lifecycles, faults, killed runs, and a hundred services at once.

`python -m bench.orchestration [--parts lifecycles faults kills hundred] [--kills 50]` runs against a fake OSM
(`tests/fakes/osm.py`) that returns recorded responses and deploys nothing.

- lifecycles: the four toolboxes and a survey worker are started, scaled and removed with `scan2sim orchestrate`.
- faults: every error status of SOL005, revoked tokens, broken connections, operations that fail or never end: the
  message, and whether the next run recovers.
- kills: `apply` is killed (SIGKILL) at random moments; the next run must reach the same final state.
- hundred: a hundred services are started with one `apply`.

Ends with `RESULT {json}`: completed `lifecycles`, `faults_tried`, `faults_clear` (clear message and recovery),
`orphans` left by all parts, `kills`, `kills_resumed`, `hundred_requests_per_second_max` (highest rate in any second of
requests about instances and operations, per instance in parallel; packages are onboarded before, one by one).
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration import apply, deployment
from scan2sim.services.orchestration.apply import ApplyResult
from scan2sim.services.orchestration.osm import HTTP_ERRORS, Osm
from scan2sim.services.orchestration.settings import ApplyParams
from tests.fakes.osm import CUT_AFTER, CUT_BEFORE, FakeOsm, Fault, OsmState

SERVICES = ("classify", "detect", "movement", "segment", "worker")
SERVICE_COUNT = 100
PARALLEL = 10
"""Number of instances that are changed at the same time, of the hundred."""


def services(folder: Path, replicas: int = 1, count: int = 0) -> Path:
    """Write a services.toml with the four toolboxes and a worker, or with `count` services."""
    names = [(f"robot-{i}", SERVICES[i % 5]) for i in range(count)] if count else [(name, name) for name in SERVICES]
    text = 'deployment = "town"\n'
    for name, service in names:
        text += f'[[service]]\nname = "{name}"\nservice = "{service}"\nreplicas = {replicas}\n'
        text += 'cluster = "edge-cluster"\n'
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return path


def apply_file(fake: FakeOsm, path: Path, timeout: float = 30.0) -> ApplyResult:
    """Apply a services.toml in this process."""
    params = ApplyParams(osm=fake.address, wait=True, timeout=timeout)
    with Osm(params) as osm:
        state = apply.load_state(osm, deployment.read(path), path.parent)
        return apply.apply(osm, state, params, lambda fraction, message="": None)


def command(fake: FakeOsm, *arguments: object) -> list[str]:
    """Command line of `scan2sim orchestrate`."""
    return [sys.executable, "-m", "scan2sim.flows.cli", "orchestrate", *map(str, arguments), "--osm", fake.address]


def lifecycles(folder: Path) -> dict[str, Any]:
    """Start, scale and remove services with the command."""
    with FakeOsm(OsmState(seconds=0.5)) as fake:
        path = services(folder)
        subprocess.run(command(fake, "apply", path, "--wait"), check=True)
        up = {one["name"] for one in fake.state.instances.values() if one["nsState"] == "READY"}
        subprocess.run(command(fake, "apply", services(folder, replicas=3), "--wait"), check=True)
        scaled = {
            fake.state.instances[one["nsInstanceId"]]["name"]
            for one in fake.state.operations.values()
            if one["lcmOperationType"] == "action" and one["operationParams"]["primitive_params"]["replicaCount"] == 3
        }
        subprocess.run(command(fake, "list"), check=True)
        subprocess.run(command(fake, "delete", path), check=True)
        left = len(fake.state.instances) + len(fake.state.functions) + len(fake.state.services)
        return {"lifecycles": 0 if left else len(up & scaled), "orphans": len(fake.state.orphans())}


def faults(folder: Path) -> dict[str, Any]:
    """A run with each fault, then one without; prints a Markdown table."""
    path, tried, clear, orphans = services(folder), 0, 0, 0
    print("| fault | message | next run |\n| --- | --- | --- |")
    for name, inject in _faults():
        with FakeOsm(OsmState(seconds=0.02)) as fake:
            inject(fake.state)
            message = _message(fake, path)
            fake.state.faults = lambda method, path: None
            fake.state.outcome = lambda kind, name: "COMPLETED"
            ended = not apply_file(fake, path).failed and len(fake.state.instances) == len(SERVICES)
            left = len(fake.state.orphans())
            tried, clear, orphans = tried + 1, clear + (ended and not left and bool(message)), orphans + left
        print(f"| {name} | {message} | {'recovers' if ended and not left else '**does not recover**'} |")
    return {"faults_tried": tried, "faults_clear": clear, "orphans": orphans}


def _faults() -> list[tuple[str, Callable[[OsmState], None]]]:
    """Functions that inject each fault, with its name."""

    def always(fault: Fault, part: str, get: bool = False) -> Callable[[OsmState], None]:
        def inject(state: OsmState) -> None:
            state.faults = lambda method, path: fault if part in path and (get or method != "GET") else None

        return inject

    def once(fault: Fault, nth: int) -> Callable[[OsmState], None]:
        def inject(state: OsmState) -> None:
            count = itertools.count()
            state.faults = lambda method, path: fault if next(count) == nth else None

        return inject

    def ends(outcome: str, kind: str) -> Callable[[OsmState], None]:
        def inject(state: OsmState) -> None:
            state.outcome = lambda done, name: outcome if (done, name) == (kind, "detect") else "COMPLETED"

        return inject

    def revoke_tokens(state: OsmState) -> None:
        count = itertools.count()
        state.faults = lambda method, path: state.tokens.clear() if next(count) % 25 == 24 else None

    found: list[tuple[str, Callable[[OsmState], None]]] = []
    for status in sorted(HTTP_ERRORS):
        for part, what in (
            ("vnf_packages", "functions"),
            ("ns_instances", "instances"),
            ("instantiate", "instantiate"),
        ):
            found.append((f"{status} to all requests about {what}", always(status, part)))
    cuts: tuple[Fault, ...] = (CUT_BEFORE, CUT_AFTER, 503, 504)
    for fault, nth in itertools.product(cuts, range(3, 60, 8)):
        found.append((f"{fault}, at request {nth}", once(fault, nth)))
    found += [
        ("the token is revoked at every 25th request", revoke_tokens),
        ("an instantiation fails", ends("FAILED", "instantiate")),
        ("an instantiation never ends", ends("never", "instantiate")),
        ("the password is rejected", always(401, "tokens", get=True)),
    ]
    return found


def _message(fake: FakeOsm, path: Path) -> str:
    """Message of a run with a fault; empty if it isn't complete."""
    try:
        result = apply_file(fake, path, timeout=1.0)
    except ScanError as error:
        return f"{error.cause}. {error.remedy}"
    if not result.failed:
        return "none: a retry succeeded"
    first = next(iter(result.failed.values()))
    return f"{first.cause}. {first.remedy}" if first.cause and first.remedy else ""


def kills(folder: Path, count: int) -> dict[str, Any]:
    """Kill `apply` at random moments of its run, and run it again."""
    rng, resumed, orphans = random.Random(0), 0, 0
    path = services(folder)
    with FakeOsm(OsmState(seconds=0.5)) as fake:
        begun = time.monotonic()
        subprocess.run(command(fake, "apply", path, "--wait"), check=True, stdout=subprocess.DEVNULL)
        whole, lasts = fake.state.summary(), time.monotonic() - begun
        first = fake.state.requests[0][0] - begun
    for number in range(count):
        with FakeOsm(OsmState(seconds=0.5)) as fake:
            run = subprocess.Popen(command(fake, "apply", path, "--wait"), stdout=subprocess.DEVNULL)
            time.sleep(rng.uniform(0.8 * first, lasts))
            run.send_signal(signal.SIGKILL)
            run.wait()
            requests = len(fake.state.requests)
            apply_file(fake, path)
            same = fake.state.summary() == whole
            resumed, orphans = resumed + same, orphans + len(fake.state.orphans())
        state = "same final state" if same else "DIFFERENT FINAL STATE"
        print(f"kill {number + 1}: after {requests} requests, {state}", flush=True)
    return {"kills": count, "kills_resumed": resumed, "orphans": orphans}


def hundred(folder: Path) -> dict[str, Any]:
    """Start a hundred services with one `apply`; each operation takes five seconds."""
    with FakeOsm(OsmState(seconds=5.0)) as fake:
        path = services(folder, count=SERVICE_COUNT)
        begun = time.monotonic()
        subprocess.run(
            command(fake, "apply", path, "--wait", "--parallel", PARALLEL), check=True, stdout=subprocess.DEVNULL
        )
        seconds = time.monotonic() - begun
        ready = sum(one["nsState"] == "READY" for one in fake.state.instances.values())
        times = sorted(when for when, _, path in fake.state.requests if "nslcm" in path)
        highest = max(bisect_left(times, when + 1.0) - i for i, when in enumerate(times))
        return {
            "hundred_requests_per_second_max": round(highest / PARALLEL, 2),
            "hundred_ready": ready,
            "hundred_seconds": round(seconds, 1),
            "hundred_running_max": max(fake.state.running_counts),
            "orphans": len(fake.state.orphans()),
        }


def main() -> None:
    """Run the parts and print their results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ["lifecycles", "faults", "kills", "hundred"]
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--kills", type=int, default=50)
    arguments = parser.parse_args()
    os.environ["OSM_PASSWORD"] = "admin"
    result: dict[str, Any] = {"orphans": 0}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = {
            "lifecycles": lambda: lifecycles(folder),
            "faults": lambda: faults(folder),
            "kills": lambda: kills(folder, arguments.kills),
            "hundred": lambda: hundred(folder),
        }
        for part in arguments.parts:
            found = made[part]()
            result |= found | {"orphans": result["orphans"] + found["orphans"]}
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
