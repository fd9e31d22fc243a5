"""Orchestration of services with OSM: operations, odd answers, lifecycles, faults, killed runs, a hundred services.

`python -m bench.orchestration [--parts operations odd lifecycles faults kills hundred] [--kills 50]` runs against a
fake OSM (`tests/fakes/osm.py`) that returns the responses recorded from OSM's own server and deploys nothing. `--osm
URL` runs the operations against another server, whose password is in $OSM_PASSWORD.

- operations: every command of `scan2sim orchestrate` that changes or reads OSM, for a container and a machine; after
  `apply` the plan must be empty.
- odd: every kind of odd or hostile answer (`tests/fakes/odd_answers.py`), during plan, apply, scale, heal and delete.

- lifecycles: the four toolboxes and a survey worker are started, scaled and removed with `scan2sim orchestrate`.
- faults: every error status of SOL005, revoked tokens, broken connections, operations that fail or never end: the
  message, and whether the next run recovers.
- kills: `apply` is killed (SIGKILL) at random moments; the next run must reach the same final state.
- hundred: a hundred services are started with one `apply`.

Ends with `RESULT {json}`: `operations_failed` of `operations_tried`, `odd_answers_unexpected` (kinds that don't end in
a message) of `odd_answers`, completed `lifecycles`, `faults_tried`, `faults_clear` (clear message and recovery),
`orphans` left by all parts, `kills`, `kills_resumed`, `hundred_requests_per_second_max` (highest rate in any second of
requests about instances and operations, per instance in parallel; packages are onboarded before, one by one).
"""

from __future__ import annotations

import argparse
import copy
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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration import apply, deployment, description, lifecycle, onboarding
from scan2sim.services.orchestration import osm as osm_client
from scan2sim.services.orchestration.apply import ApplyResult
from scan2sim.services.orchestration.osm import HTTP_ERRORS, Osm
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.settings import ApplyParams, Connection
from scan2sim.services.orchestration.sol006 import FunctionKind
from scan2sim.services.qos.requirements import Environment
from tests.fakes import odd_answers
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


def operations(folder: Path, url: str) -> dict[str, Any]:
    """Every command against a server; empty `url`: a fake."""
    with FakeOsm(OsmState(seconds=0.5)) as fake:
        failed = [words for words, expected in _commands(folder) if not _succeeds(words, expected, url or fake.address)]
        left = len(fake.state.orphans()) + len(fake.state.instances) + len(fake.state.functions)
    for words in failed:
        print("FAILED:", *words)
    return {"operations_tried": len(list(_commands(folder))), "operations_failed": len(failed), "orphans": left}


def _commands(folder: Path) -> Iterator[tuple[list[object], str]]:
    """Commands, and what each must print."""
    password, kubeconfig, path = folder / "password", folder / "kubeconfig.yaml", folder / "bench.toml"
    password.write_text("secret", encoding="utf-8")
    kubeconfig.write_text("apiVersion: v1\nkind: Config\nclusters: []\n", encoding="utf-8")
    one, two = build_packages("detect", "container"), build_packages("segment", "machine")
    packages = [made.save(folder) for made in (one.service, one.function, two.function, two.service)]
    yield (
        ["vim", "add", "bench-site", "http://vim/v3", "--vim-user", "u", "--vim-password", password, "--wait"],
        "added",
    )
    yield ["cluster", "add", "bench-cluster", kubeconfig, "--vim", "bench-site", "--wait"], "added"
    yield ["repo", "add", "bench-charts", "https://charts.example.org", "--wait"], "added"
    for kind, name in (("vim", "bench-site"), ("cluster", "bench-cluster"), ("repo", "bench-charts")):
        yield [kind, "list"], name
    for replicas, level in ((2, "info"), (3, "")):
        text = 'deployment = "bench"\n[[service]]\nname = "one"\nservice = "detect"\ncluster = "bench-cluster"\n'
        text += f"replicas = {replicas}\n" + (f'values = {{ variables = {{ LEVEL = "{level}" }} }}\n' if level else "")
        text += '[[service]]\nname = "two"\nservice = "segment"\nkind = "machine"\nvim = "bench-site"\n'
        path.write_text(text + f"replicas = {replicas}\n", encoding="utf-8")
        yield ["plan", path], "one"
        yield ["apply", path, "--wait"], "up to date"
        yield ["plan", path], "nothing to do"
    yield ["delete", path], "removed"
    yield ["onboard", *packages], "onboarded"
    for made, place in ((one, ("--cluster", "bench-cluster")), (two, ("--vim", "bench-site"))):
        name, nsd = f"of-{made.function.name[-20:-5]}".lower().replace("_", "-"), made.service.descriptor.id
        yield ["instantiate", name, nsd, *place, "--wait"], "runs"
        yield ["instantiate", name, nsd, *place, "--wait"], "runs"
        yield ["list"], nsd
        yield ["scale", name, 3, "--wait"], "3 replicas"
        yield ["heal", name, "--wait"], "healed"
        yield ["terminate", name], "terminated"
    yield ["delete", *packages], "deleted"
    for kind, name in (("repo", "bench-charts"), ("cluster", "bench-cluster"), ("vim", "bench-site")):
        yield [kind, "remove", name], "removed"


def build_packages(service: str, kind: FunctionKind) -> Packages:
    """Packages of a built-in service."""
    return build(description.read(service), Environment.EDGE, kind)


def _succeeds(words: list[object], expected: str, url: str) -> bool:
    line = [sys.executable, "-m", "scan2sim.flows.cli", "orchestrate", *map(str, words), "--osm", url]
    done = subprocess.run(line, capture_output=True, text=True)
    well = done.returncode == 0 and expected in done.stdout
    print(done.stdout if well else done.stdout + done.stderr, flush=True)
    return well


def odd(folder: Path) -> dict[str, Any]:
    """Every kind of odd answer, on a server on which the services run."""
    path, unexpected = services(folder), 0
    osm_client.RETRY_DELAY_S, osm_client.MAX_ATTEMPTS, osm_client.MAX_RESPONSE_BYTES = 0.001, 2, 2**20
    lifecycle.MAX_LOST_RESPONSES = 1
    vars(onboarding)["MAX_LOST_RESPONSES"] = 1  # each kind of answer stays; no need to wait
    new = '[[service]]\nname = "later"\nservice = "detect"\ncluster = "edge-cluster"\n'
    with FakeOsm(OsmState(seconds=0.02)) as fake:
        apply_file(fake, path)
        running = odd_answers.stored(fake.state)
    path.write_text(path.read_text("utf-8") + new, "utf-8")
    for kind, answer in odd_answers.KINDS.items():
        with FakeOsm(OsmState(seconds=0.02)) as fake, Osm(Connection(osm=fake.address)) as osm:
            vars(fake.state).update(copy.deepcopy(running))
            fake.state.answer = answer
            messages = []
            for name, call in odd_answers.calls(osm, path, "detect", "worker").items():
                try:
                    call()
                except ScanError as error:
                    messages.append(f"{name}: {error}")
                except Exception as error:
                    messages.append(f"{name}: UNEXPECTED {error!r}")
        unexpected += any("UNEXPECTED" in message for message in messages)
        print(f"{kind}: {messages[0] if messages else 'nothing'}", flush=True)
    return {"odd_answers": len(odd_answers.KINDS), "odd_answers_unexpected": unexpected, "orphans": 0}


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
    parts = ["operations", "odd", "lifecycles", "faults", "kills", "hundred"]
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--osm", default="", help="address of a server for `operations`; default: a fake")
    arguments = parser.parse_args()
    os.environ.setdefault("OSM_PASSWORD", "admin")
    result: dict[str, Any] = {"orphans": 0}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = {
            "operations": lambda: operations(folder, arguments.osm),
            "odd": lambda: odd(folder),
            "lifecycles": lambda: lifecycles(folder),
            "faults": lambda: faults(folder),
            "kills": lambda: kills(folder, arguments.kills),
            "hundred": lambda: hundred(folder),
        }
        for part in sorted(arguments.parts, key=lambda name: name == "odd"):  # last: it shortens waits for good
            found = made[part]()
            result |= found | {"orphans": result["orphans"] + found["orphans"]}
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
