"""Where the steps of a flow run, by name: in threads of its process, on workers of Dask, on workers of Ray.

A task of Prefect waits in the flow's process for its step; the worker knows of the step alone. So workers need neither
Prefect nor its server. (Prefect's own runners for Dask and Ray set up Prefect's client, settings and context on the
worker anew for every task, which costs more than many a step takes.)
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.optional_deps import need

Call = Callable[..., Any]
"""Has a worker call a function with arguments, waits, and returns its result or raises its exception."""


def workers(name: str, count: int, address: str | None = None) -> AbstractContextManager[Call]:
    """Workers that call one function at a time each; what a worker was at that died is done by another.

    Args:
        name: "threads", "dask" or "ray".
        count: of workers that are started here.
        address: of a Dask scheduler or a Ray cluster, whose workers are taken instead.

    Raises:
        UnavailableError: once entered, nothing answers at the address.
        ScanError: as `check`.
    """
    check(name)
    return {"threads": _threads, "dask": _dask, "ray": _ray}[name](count, address)


def check(name: str) -> None:
    """See that there is such a kind of workers here.

    Raises:
        SettingError: there is no such kind.
        UnavailableError: its package isn't installed.
    """
    packages: dict[str, list[str]] = {"threads": [], "dask": ["distributed"], "ray": ["ray"]}
    if name not in packages:
        raise SettingError("runner", f"there is no `{name}`", "Choose threads, dask or ray")
    need(f"--runner {name}", *packages[name])


@contextmanager
def _threads(count: int, address: str | None) -> Iterator[Call]:
    yield lambda function, *arguments: function(*arguments)


@contextmanager
def _dask(count: int, address: str | None) -> Iterator[Call]:
    import dask
    from distributed import Client

    # Dask would count a step's memory as its worker's, and kill it
    own: dict[str, Any] = {"n_workers": count, "threads_per_worker": 1, "memory_limit": 0}
    own["dashboard_address"] = "127.0.0.1:0"  # it asks for no token
    unwatched = {"distributed.worker.profile.enabled": False}  # a hundred looks a second at what a worker does
    try:
        with dask.config.set(unwatched):
            client = Client(address) if address else Client(**own)
    except OSError as error:
        raise _away(address, "scheduler of Dask", error) from error
    with client:
        yield lambda function, *arguments: client.submit(function, *arguments, pure=False).result()


@contextmanager
def _ray(count: int, address: str | None) -> Iterator[Call]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported home
    import ray

    own: dict[str, Any] = {"address": "local", "num_cpus": count, "include_dashboard": False}
    try:
        if address and re.fullmatch(r"[^/]+:\d+", address):  # Ray itself would try for minutes
            host, port = address.rsplit(":", 1)
            socket.create_connection((host, int(port)), 10).close()
        ray.init(address=address) if address else ray.init(**own)
    except OSError as error:
        raise _away(address, "cluster of Ray", error) from error

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return ray.get(ray.remote(function).remote(*arguments))
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None

    try:
        yield call
    finally:
        ray.shutdown()


def _away(address: str | None, what: str, error: Exception) -> UnavailableError:
    return UnavailableError(address or "localhost", f"no {what} answers ({error})", "Start it, or correct --address")
