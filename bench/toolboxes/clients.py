"""Clients of a toolbox (part `clients` of `bench.toolboxes`): Triton's own, and others beside slow bodies."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.toolboxes.load import sample_jpegs
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes import tasks
from scan2sim.services.toolboxes.api import application
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference import grpc_server
from tests.fakes.interpreters import TRITON_PYTHON
from tests.fakes.toolbox_clients import SLOW_POSTS, call_by_triton, response_s, slow_posts

BOX = "detect"
LIMIT_S = 1.0
"""Time within which health and other callers are to be served."""
ROUNDS = 20
HEALTH_PATHS = ("health/live", "health/ready", "v2/health/live", "v2/health/ready")


def clients() -> dict[str, Any]:
    """Calls by Triton's client that fail, and the share of requests served within a second beside slow bodies.

    Returns:
        triton_calls, triton_failed: number of calls; None without the client. slow_bodies_served: share of requests.
    """
    found: dict[str, Any] = {"triton_calls": None, "triton_failed": None}
    with _served() as (port, grpc_address):
        if TRITON_PYTHON.exists():
            with tempfile.TemporaryDirectory() as folder:
                files = [Path(folder) / f"{number}.jpg" for number in range(4)]
                for file, jpeg in zip(files, sample_jpegs(), strict=False):
                    file.write_bytes(jpeg)
                calls = call_by_triton(BOX, port, grpc_address, files)
            for call, error in calls["failed"].items():
                print(f"{call}: {error}")
            found = {"triton_calls": calls["calls"], "triton_failed": len(calls["failed"])}
        found["slow_bodies_served"] = _slow_bodies_served(port)
    print(f"{BOX}, beside {SLOW_POSTS} posts with slow bodies: {found}", flush=True)
    return found


@contextmanager
def _served() -> Iterator[tuple[int, str]]:
    """A toolbox by HTTP and gRPC; yields the port of HTTP and the address of gRPC."""
    engine, params, addresses = Engine(BOX, tasks.find(BOX).Params()), ServerParams(port=0), list[str]()
    app = application(engine, params)
    threading.Thread(target=factory.run, args=(app, params, addresses.append), daemon=True).start()
    with grpc_server.serving(engine, params, 0) as grpc_address:
        while not addresses:
            time.sleep(0.05)
        yield int(addresses[0].strip("/").rpartition(":")[2]), grpc_address
    engine.close()


def _slow_bodies_served(port: int) -> float:
    """Share of health checks and inferences that are answered in time while bodies arrive slowly."""
    url, infer, image = f"http://127.0.0.1:{port}/", f"v2/models/{BOX}/infer", sample_jpegs()[0]
    response_s(url + infer, image)
    times: list[float] = []
    with slow_posts(port, f"/{infer}"):
        for _ in range(ROUNDS):
            times += [response_s(url + path) for path in HEALTH_PATHS]
            times.append(response_s(url + infer, image))
    print(f"longest response {max(times):.2f} s of {len(times)}")
    return round(sum(one < LIMIT_S for one in times) / len(times), 3)
