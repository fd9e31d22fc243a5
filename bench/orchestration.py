"""Services through OSM: whole lifecycles, faults, kills, and a hundred at once.

`python -m bench.orchestration [--parts lifecycles faults kills hundred] [--kills 50]`, against OSM's stand-in
(`tests/fakes/osm.py`), which answers as OSM's own interface was seen to; nothing runs behind it.

- lifecycles: the four toolboxes and a worker of surveys are brought up, scaled and removed by `scan2sim orchestrate`.
- faults: every refusal that SOL005 names, a token that is taken back, connections cut, operations that fail or never
  end: what was said, and whether the next run ends as if nothing had been.
- kills: `apply` killed (SIGKILL) at random moments; the next run must end in the same state.
- hundred: services brought up by one `apply`.

Ends with `RESULT {json}`: `lifecycles` that went through, `faults_tried`, `faults_clear`, `orphans` left in all of it,
`kills`, `kills_resumed`, `hundred_requests_per_second_max` (in any second, about instances and their operations, for
each of those that are worked on at once; packages are sent before, one after another).
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
from scan2sim.services.orchestration.apply import Applied
from scan2sim.services.orchestration.osm import FAULTS, Osm
from scan2sim.services.orchestration.settings import ApplyParams
from tests.fakes.osm import CUT_AFTER, CUT_BEFORE, Fake, Fault, State

TOWN = ("classify", "detect", "movement", "segment", "worker")
HUNDRED = 100
PARALLEL = 10
"""Instances that are worked on at once, of the hundred."""


def services(folder: Path, replicas: int = 1, count: int = 0) -> Path:
    """A services.toml of the four toolboxes and a worker, or of so many services."""
    names = [(name, name) for name in TOWN] if not count else [(f"robot-{i}", TOWN[i % 5]) for i in range(count)]
    text = 'deployment = "town"\n'
    for name, service in names:
        text += f'[[service]]\nname = "{name}"\nservice = "{service}"\nreplicas = {replicas}\n'
        text += 'cluster = "edge-cluster"\n'
    path = folder / "services.toml"
    path.write_text(text, encoding="utf-8")
    return path


def bring(fake: Fake, path: Path, timeout: float = 30.0) -> Applied:
    """Apply a file, here."""
    params = ApplyParams(osm=fake.address, wait=True, timeout=timeout)
    with Osm(params) as osm:
        there = apply.target(osm, deployment.read(path), path.parent)
        return apply.apply(osm, there, params, lambda fraction, message="": None)


def command(fake: Fake, *arguments: object) -> list[str]:
    """Of `scan2sim orchestrate`."""
    return [sys.executable, "-m", "scan2sim.flows.cli", "orchestrate", *map(str, arguments), "--osm", fake.address]


def lifecycles(folder: Path) -> dict[str, Any]:
    """Bring up, scale and remove by the command."""
    with Fake(State(seconds=0.5)) as fake:
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
    """Each fault, then a run without: a line of a table each."""
    path, tried, clear, orphans = services(folder), 0, 0, 0
    print("| fault | what was said | the next run |\n| --- | --- | --- |")
    for name, spoil in _faults():
        with Fake(State(seconds=0.02)) as fake:
            spoil(fake.state)
            said = _said(fake, path)
            fake.state.faults = lambda method, path: None
            fake.state.outcome = lambda kind, name: "COMPLETED"
            ended = not bring(fake, path).failed and len(fake.state.instances) == len(TOWN)
            left = len(fake.state.orphans())
            tried, clear, orphans = tried + 1, clear + (ended and not left and bool(said)), orphans + left
        print(f"| {name} | {said} | {'ends as if it had not been' if ended and not left else '**does not mend it**'} |")
    return {"faults_tried": tried, "faults_clear": clear, "orphans": orphans}


def _faults() -> list[tuple[str, Callable[[State], None]]]:
    """What goes wrong, by name."""

    def always(fault: Fault, part: str, get: bool = False) -> Callable[[State], None]:
        def spoil(state: State) -> None:
            state.faults = lambda method, path: fault if part in path and (get or method != "GET") else None

        return spoil

    def once(fault: Fault, nth: int) -> Callable[[State], None]:
        def spoil(state: State) -> None:
            count = itertools.count()
            state.faults = lambda method, path: fault if next(count) == nth else None

        return spoil

    def ends(outcome: str, kind: str) -> Callable[[State], None]:
        def spoil(state: State) -> None:
            state.outcome = lambda done, name: outcome if (done, name) == (kind, "detect") else "COMPLETED"

        return spoil

    def token(state: State) -> None:
        count = itertools.count()
        state.faults = lambda method, path: state.tokens.clear() if next(count) % 25 == 24 else None

    found: list[tuple[str, Callable[[State], None]]] = []
    for status in sorted(FAULTS):
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
        ("the token is taken back at every 25th request", token),
        ("an instantiation fails", ends("FAILED", "instantiate")),
        ("an instantiation never ends", ends("never", "instantiate")),
        ("the password is refused", always(401, "tokens", get=True)),
    ]
    return found


def _said(fake: Fake, path: Path) -> str:
    """What a run says, in one sentence; "" if it says nothing clear."""
    try:
        applied = bring(fake, path, timeout=1.0)
    except ScanError as error:
        return f"{error.cause}. {error.remedy}"
    if not applied.failed:
        return "nothing: it was tried again"
    first = next(iter(applied.failed.values()))
    return f"{first.cause}. {first.remedy}" if first.cause and first.remedy else ""


def kills(folder: Path, count: int) -> dict[str, Any]:
    """Kill `apply` at random moments of its run, and run it again."""
    rng, resumed, orphans = random.Random(0), 0, 0
    path = services(folder)
    with Fake(State(seconds=0.5)) as fake:
        begun = time.monotonic()
        subprocess.run(command(fake, "apply", path, "--wait"), check=True, stdout=subprocess.DEVNULL)
        whole, lasts = fake.state.summary(), time.monotonic() - begun
        first = fake.state.asked[0][0] - begun
    for number in range(count):
        with Fake(State(seconds=0.5)) as fake:
            run = subprocess.Popen(command(fake, "apply", path, "--wait"), stdout=subprocess.DEVNULL)
            time.sleep(rng.uniform(0.8 * first, lasts))
            run.send_signal(signal.SIGKILL)
            run.wait()
            asked = len(fake.state.asked)
            bring(fake, path)
            same = fake.state.summary() == whole
            resumed, orphans = resumed + same, orphans + len(fake.state.orphans())
        print(f"kill {number + 1}: after {asked} requests, {'the same end' if same else 'ANOTHER END'}", flush=True)
    return {"kills": count, "kills_resumed": resumed, "orphans": orphans}


def hundred(folder: Path) -> dict[str, Any]:
    """A hundred services in one `apply`, whose operations take five seconds."""
    with Fake(State(seconds=5.0)) as fake:
        path = services(folder, count=HUNDRED)
        begun = time.monotonic()
        subprocess.run(
            command(fake, "apply", path, "--wait", "--parallel", PARALLEL), check=True, stdout=subprocess.DEVNULL
        )
        seconds = time.monotonic() - begun
        ready = sum(one["nsState"] == "READY" for one in fake.state.instances.values())
        times = sorted(when for when, _, path in fake.state.asked if "nslcm" in path)
        most = max(bisect_left(times, when + 1.0) - i for i, when in enumerate(times))
        return {
            "hundred_requests_per_second_max": round(most / PARALLEL, 2),
            "hundred_ready": ready,
            "hundred_seconds": round(seconds, 1),
            "hundred_running_max": max(fake.state.running),
            "orphans": len(fake.state.orphans()),
        }


def main() -> None:
    """Run the parts, and print their figures."""
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
