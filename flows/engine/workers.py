"""Workers that run the steps of a flow: threads of its process, Dask workers or Ray workers.

A Prefect task waits in the flow's process while a worker runs the step. So workers need neither Prefect nor its server.
(Prefect's own task runners for Dask and Ray set up Prefect's client, settings and context on the worker for every task,
which takes longer than many steps.)
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.optional_deps import require

Call = Callable[..., Any]
"""Calls a function on a worker, waits, and returns its result or raises its exception."""
NO_WORKERS = "the {what} at {address} has no workers: steps wait until one connects (`{command}`)"
STEPS_OF_EMPTY_CLUSTER = 64
"""Number of steps for a cluster without workers yet: one that grows on demand must see a demand."""


@dataclass(frozen=True)
class Workers:
    """Workers that are ready.

    Attributes:
        call: calls a function on one of them.
        count: number of functions that they run at the same time.
    """

    call: Call
    count: int


def ignore_warning(text: str) -> None:
    """A callback for warnings that does nothing."""


def workers(
    name: str, count: int, address: str | None = None, warn: Callable[[str], None] = ignore_warning
) -> AbstractContextManager[Workers]:  # fmt: skip
    """Workers that run one function at a time each; if a worker dies, another one repeats its function.

    Args:
        name: "threads", "dask" or "ray".
        count: number of workers to start here, or to use at the address; 0: all that are there.
        address: of a Dask scheduler or a Ray cluster whose workers to use instead.
        warn: receives a warning if there are no workers at the address, for which every step waits.

    Raises:
        UnavailableError: when the context is entered, nothing answers at the address.
        ScanError: as `check`.
    """
    check(name)
    return {"threads": _threads, "dask": _dask, "ray": _ray}[name](count, address, warn)


def check(name: str) -> None:
    """Check that this kind of workers exists and is installed.

    Raises:
        SettingError: there is no such kind.
        UnavailableError: its package isn't installed.
    """
    packages: dict[str, list[str]] = {"threads": [], "dask": ["distributed"], "ray": ["ray"]}
    if name not in packages:
        raise SettingError("runner", f"there is no `{name}`", "Choose threads, dask or ray")
    require(f"--runner {name}", *packages[name])


@contextmanager
def _threads(count: int, address: str | None, warn: Callable[[str], None]) -> Iterator[Workers]:
    yield Workers(lambda function, *arguments: function(*arguments), count or 1)


@contextmanager
def _dask(count: int, address: str | None, warn: Callable[[str], None]) -> Iterator[Workers]:
    import dask
    from distributed import Client

    # by default Dask counts the memory of a step's process as its worker's, and kills the worker
    local: dict[str, Any] = {"n_workers": count, "threads_per_worker": 1, "memory_limit": 0}
    local["dashboard_address"] = "127.0.0.1:0"  # the dashboard has no authentication
    no_profiler = {"distributed.worker.profile.enabled": False}  # it samples workers a hundred times per second
    try:
        with dask.config.set(no_profiler):
            client = Client(address) if address else Client(**local)
    except OSError as error:
        raise _unreachable(address, "Dask scheduler", error) from error
    with client:
        if address:
            there = sum(worker["nthreads"] for worker in client.scheduler_info()["workers"].values())
            if there == 0:
                warn(NO_WORKERS.format(what="Dask scheduler", address=address, command=f"dask worker {address}"))
            count = count or there or STEPS_OF_EMPTY_CLUSTER
        yield Workers(lambda function, *arguments: client.submit(function, *arguments, pure=False).result(), count)


@contextmanager
def _ray(count: int, address: str | None, warn: Callable[[str], None]) -> Iterator[Workers]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry
    import ray

    local: dict[str, Any] = {"address": "local", "num_cpus": count, "include_dashboard": False}
    try:
        if address and re.fullmatch(r"[^/]+:\d+", address):  # Ray itself retries for minutes
            host, port = address.rsplit(":", 1)
            socket.create_connection((host, int(port)), 10).close()
        ray.init(address=address) if address else ray.init(**local)
    except OSError as error:
        raise _unreachable(address, "Ray cluster", error) from error

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return ray.get(ray.remote(function).remote(*arguments))
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None

    try:
        if address:
            there = int(ray.cluster_resources().get("CPU", 0))  # type: ignore[no-untyped-call]
            if there == 0:
                command = f"ray start --address {address}"
                warn(NO_WORKERS.format(what="Ray cluster", address=address, command=command))
            count = count or there or STEPS_OF_EMPTY_CLUSTER
        yield Workers(call, count)
    finally:
        ray.shutdown()


def _unreachable(address: str | None, what: str, error: Exception) -> UnavailableError:
    return UnavailableError(address or "localhost", f"no {what} answers ({error})", "Start it, or correct --address")
