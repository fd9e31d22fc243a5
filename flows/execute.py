"""Runs a recipe: plans what is missing, runs it in processes, keeps every result in the store."""

from __future__ import annotations

import fcntl
import importlib.metadata
import multiprocessing
import os
import platform
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Literal

from scan2sim import __version__
from scan2sim.flows.graph import Node, NodeId
from scan2sim.flows.memory import need, share
from scan2sim.flows.planning import Planned, check
from scan2sim.pipeline import libraries
from scan2sim.pipeline.errors import BusyError, DamagedError, ScanError, StepError, UnavailableError, from_os_error
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.store import Manifest, Store

APART = ("flows", "ray", "s3", "dev")
"""Extras that hand work out, bring files or try the project: no result depends on their packages."""
TRACKER = "ignore:resource_tracker"
"""A filter of warnings for Python's own process that clears up after killed ones, and says so."""
SAID = 10_000
"""Bytes of what a failed step's libraries printed that go into the log."""
Event = Literal["start", "progress", "done", "kept", "failed", "again"]
Watch = Callable[[Node, Event, float, str], None]
"""Told what happens: node, event, fraction done, message."""


@dataclass(frozen=True)
class Outcome:
    """What came of a plan.

    Attributes:
        done: results, what is kept from before among them.
        failed: why others failed; what depends on them is in neither.
    """

    done: Mapping[NodeId, Manifest]
    failed: Mapping[NodeId, ScanError]

    def of_tile(self, tile: str = "") -> dict[str, Manifest]:
        """Results of one tile by their names within it (`poisson.terrain`)."""
        return {node.name: manifest for node, manifest in self.done.items() if node.tile == tile}

    def check(self) -> None:
        """Raise the first error, if any node failed."""
        for error in self.failed.values():
            raise error


Executor = Callable[[list[Planned], Store], Outcome]
"""Runs what a plan says is missing."""


class Frontier:
    """Which nodes of a plan can run next, as results come in.

    Attributes:
        done: results; what is kept from before comes by itself.
        failed: why others failed.
    """

    def __init__(self, planned: Sequence[Planned], store: Store, watch: Watch) -> None:
        self.done: dict[NodeId, Manifest] = {}
        self.failed: dict[NodeId, ScanError] = {}
        self._store, self._watch = store, watch
        self._planned = {item.node.id: item for item in planned}
        self._labels = {item.node.label: item.node.id for item in planned}
        self._waiting = dict(self._planned)
        self._missing: set[NodeId] = set()  # known not to be kept
        self._lost: set[NodeId] = set()  # failed, or in need of what failed

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def outcome(self) -> Outcome:
        """As far as the plan has come."""
        return Outcome(self.done, self.failed)

    def ready(self) -> Iterator[Planned]:
        """Nodes that can run now, in the plan's order; to be taken, or offered again."""
        for node, item in list(self._waiting.items()):
            if not self._lost.isdisjoint(item.upstream):
                self.take(item)
                self._lost.add(node)
            elif all(name in self.done for name in item.upstream):
                kept = None if node in self._missing else item.kept(self._store)
                if kept is None:
                    self._missing.add(node)
                    yield item
                else:
                    self.take(item)
                    self.done[node] = kept
                    self._watch(item.node, "kept", 1.0, "")

    def take(self, item: Planned) -> None:
        """The node has been started."""
        self._waiting.pop(item.node.id, None)

    def end(self, item: Planned, manifest: Manifest) -> None:
        """The node is done; what it has read was intact."""
        self.done[item.node.id] = manifest
        for node in (item.node.id, *item.upstream):
            self._store.trust(node.label, self._planned[node].key)
        self._watch(item.node, "done", 1.0, "")

    def again(self, item: Planned, error: DamagedError) -> None:
        """The node has met a result that is damaged: that is made anew, and the node waits for it."""
        self._waiting[item.node.id] = item
        damaged = self._labels[error.where]
        if self.done.pop(damaged, None) is not None:
            self._store.discard(damaged.label, self._planned[damaged].key)
            self._missing.add(damaged)
            self._waiting[damaged] = self._planned[damaged]
        self._watch(item.node, "again", 0.0, f"the kept result of {damaged} is damaged: made anew")

    def fail(self, item: Planned, error: ScanError) -> None:
        """The node, and whatever depends on it, will not be done."""
        self.take(item)
        self._lost.add(item.node.id)
        self.failed[item.node.id] = error
        self._watch(item.node, "failed", 1.0, error.cause)


def execute(
    planned: Sequence[Planned],
    store: Store,
    *,
    jobs: int,
    watch: Watch,
    to_the_end: bool = False,
    memory: float | None = None,
) -> Outcome:
    """Run what the plan says is missing, up to `jobs` nodes at a time, each in a process of its own.

    Args:
        to_the_end: run all that doesn't depend on what has failed, rather than stop at the first failure.
        memory: GB that nodes may need together (`flows.memory`); one that needs more runs alone.

    Raises:
        ScanError: of a node that can't run here, before any does.
        KeyboardInterrupt: what was finished is kept.
    """
    check(planned)
    front = Frontier(planned, store, watch)
    running: dict[Connection, tuple[Planned, ForkServerProcess, float]] = {}
    try:
        while front or running:
            for item in front.ready():
                if len(running) >= jobs:
                    break
                try:
                    needed = 0.0 if memory is None else need(item, store)
                    if memory is not None and running and sum(r[2] for r in running.values()) + needed > memory:
                        continue
                    started, process = _start(item, store)
                except DamagedError as error:
                    front.again(item, error)
                    break
                front.take(item)
                watch(item.node, "start", 0.0, "")
                running[started] = (item, process, needed)
            for connection in wait(list(running), timeout=1.0) if running else ():
                assert isinstance(connection, Connection)
                item, process, _ = running[connection]
                try:
                    manifest = _receive(connection, item, process, watch)
                except DamagedError as error:
                    front.again(item, error)
                except ScanError as error:
                    front.fail(item, error)
                    if not to_the_end:
                        return front.outcome
                else:
                    if manifest is None:
                        continue
                    front.end(item, manifest)
                process.join()
                del running[connection]
    finally:
        for _, process, _ in running.values():
            _stop(process)
    return front.outcome


def check_version(item: Planned, wanted: Mapping[str, str]) -> None:
    """Refuse to run a node with other code than the flow's that planned it.

    Args:
        wanted: the flow's `versions()`; what isn't installed here is left to the steps, which say what they lack.

    Raises:
        UnavailableError: this machine has another version of the project, of the step, or of what computes it.
    """
    from scan2sim.flows.recipe import STEPS

    mine, name = versions(), item.node.step.name
    others = [f"{k} {mine[k]} instead of {v}" for k, v in wanted.items() if mine.get(k, v) != v]
    local = next((step.version for step in STEPS if step.name == name), item.node.step.version)
    if local != item.node.step.version:
        others.append(f"version {local} of step {name} instead of {item.node.step.version}")
    if others:
        remedy = "Install the same version on all workers as where the flow runs, and start them again"
        raise UnavailableError(platform.node(), f"this worker has {', '.join(others)}", remedy)


def limit_cores(cores: int | None) -> None:
    """Let steps that this process starts use so many cores each; None: all. Counts from the first step on."""
    if cores is not None:
        for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OPENBLAS_NUM_THREADS"):
            os.environ[name] = str(cores)


def run_apart(item: Planned, store: Store, watch: Watch) -> Manifest:
    """Run one node in a process of its own and wait for it; a result that is there by now is kept.

    Raises:
        ScanError: as `run_node`.
    """
    kept = item.kept(store)
    if kept is not None:
        return kept
    connection, process = _start(item, store)
    try:
        while True:
            manifest = _receive(connection, item, process, watch)
            if manifest is not None:
                process.join()
                return manifest
    finally:
        _stop(process)


def run_on_worker(
    item: Planned, store: Store, memory: float | None, cores: int | None, wanted: Mapping[str, str]
) -> Manifest:
    """Run one node as a worker that serves a flow elsewhere.

    Args:
        memory: GB that steps on one machine may need together (`flows.memory`).
        cores: that the step may use.
        wanted: the flow's `versions()`.

    Raises:
        UnavailableError: this worker has other versions, or lacks libraries.
        ScanError: as `run_node`.
    """
    check_version(item, wanted)
    libraries.check()
    limit_cores(cores)
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # Dask's, for processes that live on: it slows steps down
    with share(memory, need(item, store)):
        return run_apart(item, store, lambda *_: None)


def run_node(item: Planned, store: Store, inputs: dict[str, Path], report: Report = silent) -> Manifest:
    """Run one node in this process and keep its result.

    Raises:
        DamagedError: a result that it reads isn't as it was made.
        ScanError: as the step says; a full disk as `SpaceError`; anything else as `StepError`.
    """
    node = item.node
    item.check(store)
    fed = item.fed(store)
    folder = store.begin(node.label)
    start = time.perf_counter()
    _forget_peak()
    try:
        result = node.step.run(inputs, node.params, folder, report)
        about = {
            "version": node.step.version,
            "params": node.params.model_dump(mode="json"),
            "inputs": item.keys,
            "fed": fed,
            "seconds": round(time.perf_counter() - start, 3),
            "peak_mb": _peak_mb(),
        }
        return store.commit(node.label, item.key, folder, result, about)
    except ScanError:
        raise
    except OSError as error:
        raise from_os_error(error, folder) from error
    except MemoryError as error:
        raise StepError(node.label, "ran out of memory", "Use a smaller tile, or larger voxels") from error
    except Exception as error:
        raise StepError(
            node.label,
            f"failed unexpectedly ({type(error).__name__}: {error})",
            "The log holds the details; please report it",
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # moved away by now, unless it failed


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder for one run at a time.

    Raises:
        BusyError: another run holds it.
        SpaceError: it can't be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(folder / ".lock", "w")
    except OSError as error:
        raise from_os_error(error, folder) from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BusyError(folder, "another run is writing here", "Wait for it, or choose another --out") from None
        yield


@cache
def versions() -> Mapping[str, str]:
    """Versions of Python, the project and what it computes with, as far as that is installed."""
    found = {"python": sys.version.split()[0], "scan2sim": __version__}
    with suppress(importlib.metadata.PackageNotFoundError):
        for line in importlib.metadata.requires("scan2sim") or ():
            extra = re.search(r"extra == ['\"]([\w-]+)", line)
            if extra is None or extra[1] not in APART:
                name = re.split(r"[^\w.-]", line)[0]
                with suppress(importlib.metadata.PackageNotFoundError):
                    found[name] = importlib.metadata.version(name)
    return found


def _processes() -> Any:
    """Processes forked from a server that has the heavy libraries loaded."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # several nodes share the cores: don't spin
    if TRACKER not in sys.warnoptions:
        sys.warnoptions.append(TRACKER)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["scan2sim.flows.preload"])
    # Ctrl-C in a terminal reaches the server as well: until it is ready, it would die of it, and say so at length
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _start(item: Planned, store: Store) -> tuple[Connection, ForkServerProcess]:
    """Start a node in a process of its own."""
    # workers of a cluster are daemons, which may not have children; ours end with them (`_end_with_the_run`)
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    context = _processes()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, item, store, item.inputs(store)))
    process.start()
    theirs.close()
    return ours, process


def _child(connection: Connection, item: Planned, store: Store, inputs: dict[str, Path]) -> None:
    """Body of a node's process: sends ("progress", fraction, message), then ("done" | "error", value, log).

    What libraries print is kept from the screen, and goes into the log with an error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and stops its children
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    os.setpgrp()
    said = tempfile.TemporaryFile() if sys.platform != "linux" else os.fdopen(os.memfd_create("said"), "w+b")
    for stream in (1, 2):
        os.dup2(said.fileno(), stream)
    threading.Thread(target=_end_with_the_run, daemon=True).start()

    def report(fraction: float, message: str = "") -> None:
        connection.send(("progress", fraction, message))

    try:
        connection.send(("done", run_node(item, store, inputs, report), ""))
    except ScanError as error:
        said.seek(max(0, said.seek(0, os.SEEK_END) - SAID))
        heard = said.read().decode(errors="replace")
        connection.send(("error", error, traceback.format_exc() + heard))


def _end_with_the_run() -> None:
    """Wait for the death of the process that runs the recipe, and follow it: nobody would take the result."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _receive(connection: Connection, item: Planned, process: ForkServerProcess, watch: Watch) -> Manifest | None:
    """Handle one message of a node; its manifest once it is done."""
    try:
        kind, value, message = connection.recv()
    except EOFError:
        process.join()
        cause = "was killed, probably for want of memory" if process.exitcode == -signal.SIGKILL else "crashed"
        raise StepError(
            item.node.label,
            f"{cause} (exit status {process.exitcode})",
            "Run again with --jobs 1, or use a smaller tile",
        ) from None
    if kind == "progress":
        watch(item.node, "progress", value, message)
        return None
    if kind == "error":
        value.add_note(message)
        raise value
    return value


def _stop(process: ForkServerProcess) -> None:
    """End a node's process and whatever it has started."""
    if process.pid is None or not process.is_alive():
        return
    process.terminate()
    process.join(2)
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()


def _forget_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass  # not Linux: the peak is then that of the process so far


def _peak_mb() -> float:
    """Peak resident memory of this process and of its largest child, MB."""
    import resource

    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        status = Path("/proc/self/status").read_text()
        own = int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        pass
    return round((own + resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024, 1)
