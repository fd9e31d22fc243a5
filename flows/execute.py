"""Runs a recipe: plans what is missing, runs it in processes, keeps every result in the store."""

from __future__ import annotations

import fcntl
import importlib.metadata
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Literal

from flows.recipe import Node, Output
from pipeline.errors import BusyError, ScanError, StepError, from_os_error
from pipeline.step import Report, silent
from pipeline.store import Manifest, Store, digest, key_of

Event = Literal["start", "progress", "done", "kept"]
Watch = Callable[[Node, Event, float, str], None]
"""Told what happens: node, event, fraction done, message."""


@dataclass(frozen=True)
class Planned:
    """A node with its key, and why it will run (None: its result is kept).

    Attributes:
        keys: input name to the key (of a node's output) or digest (of a file).
    """

    node: Node
    key: str
    keys: dict[str, str]
    reason: str | None


def plan(nodes: Sequence[Node], store: Store, *, force: bool = False, start: str | None = None) -> list[Planned]:
    """What would run and why, in order.

    Args:
        force: everything runs again.
        start: the name of a step that runs again, with all that depends on it.
    """
    planned: dict[str, Planned] = {}
    digests: dict[Path, str] = {}
    for node in nodes:
        keys = {}
        for name, source in sorted(node.inputs.items()):
            if isinstance(source, Output):
                keys[name] = f"{planned[source.node].key}/{source.name}"
            else:
                if source not in digests:
                    digests[source] = digest(source)
                keys[name] = digests[source]
        key = key_of(node.step, node.params, keys)
        reason = _reason(node, key, store)
        if force:
            reason = "forced"
        elif start is not None and node.step.name == start:
            reason = f"asked for by --from {start}"
        elif start is not None:
            upstream = [s.node for s in node.inputs.values() if isinstance(s, Output)]
            again = [name for name in upstream if (planned[name].reason or "").startswith(("asked", "follows"))]
            reason = f"follows {again[0]}" if again else reason
        planned[node.label] = Planned(node, key, keys, reason)
    return list(planned.values())


def _reason(node: Node, key: str, store: Store) -> str | None:
    if store.find(node.label, key) is not None:
        return None
    if store.folder(node.label, key).exists():
        return "its result was damaged or deleted"
    others = [p for p in (store.root / node.label).glob("*") if not p.name.startswith(".")]
    return "its input, settings or version changed" if others else "it was never run"


def execute(planned: Sequence[Planned], store: Store, *, jobs: int, watch: Watch) -> dict[str, Manifest]:
    """Run what the plan says is missing, up to `jobs` nodes at a time, each in a process of its own.

    Raises:
        ScanError: of the first node that failed; what was finished is kept.
        KeyboardInterrupt: likewise.
    """
    done: dict[str, Manifest] = {}
    waiting = list(planned)
    running: dict[Connection, tuple[Planned, ForkServerProcess]] = {}
    context = _processes()
    try:
        while waiting or running:
            for item in list(waiting):
                if len(running) >= jobs:
                    break
                if not all(s.node in done for s in item.node.inputs.values() if isinstance(s, Output)):
                    continue
                waiting.remove(item)
                kept = store.find(item.node.label, item.key) if item.reason is None else None
                if kept is not None:
                    done[item.node.label] = kept
                    watch(item.node, "kept", 1.0, "")
                    continue
                ours, theirs = context.Pipe(duplex=False)
                inputs = _paths(item.node, store, {p.node.label: p for p in planned}, done)
                process = context.Process(target=_child, args=(theirs, item, store, inputs))
                watch(item.node, "start", 0.0, "")
                process.start()
                theirs.close()
                running[ours] = (item, process)
            for connection in wait(list(running), timeout=1.0) if running else ():
                assert isinstance(connection, Connection)
                item, process = running[connection]
                manifest = _receive(connection, item, process, watch)
                if manifest is not None:
                    done[item.node.label] = manifest
                    process.join()
                    del running[connection]
                    watch(item.node, "done", 1.0, "")
    finally:
        for _, process in running.values():
            _stop(process)
    return done


def run_node(item: Planned, store: Store, inputs: dict[str, Path], report: Report = silent) -> Manifest:
    """Run one node in this process and keep its result; what a Prefect task calls too.

    Raises:
        ScanError: as the step says; a full disk as `SpaceError`; anything else as `StepError`.
    """
    node = item.node
    folder = store.begin(node.label)
    start = time.perf_counter()
    _forget_peak()
    try:
        result = node.step.run(inputs, node.params, folder, report)
        about = {
            "version": node.step.version,
            "params": node.params.model_dump(mode="json"),
            "inputs": item.keys,
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


def versions() -> dict[str, str]:
    """Versions of Python, the project and what it computes with, for the report."""
    names = ("scan2sim", "numpy", "open3d-cpu", "open3d", "xatlas", "pyfqmr", "laspy", "opencv-python-headless")
    found = {"python": sys.version.split()[0]}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _processes() -> Any:
    """Processes forked from a server that has the heavy libraries loaded."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # several nodes share the cores: don't spin
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["flows.preload"])
    return context


def _paths(node: Node, store: Store, planned: dict[str, Planned], done: dict[str, Manifest]) -> dict[str, Path]:
    paths = {}
    for name, source in node.inputs.items():
        if isinstance(source, Output):
            folder = store.folder(source.node, planned[source.node].key)
            paths[name] = folder / done[source.node].files[source.name]
        else:
            paths[name] = source
    return paths


def _child(connection: Connection, item: Planned, store: Store, inputs: dict[str, Path]) -> None:
    """Body of a node's process: sends ("progress", fraction, message), then ("done" | "error", value, log)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and stops its children
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    os.setpgrp()
    threading.Thread(target=_end_with_the_run, daemon=True).start()

    def report(fraction: float, message: str = "") -> None:
        connection.send(("progress", fraction, message))

    try:
        connection.send(("done", run_node(item, store, inputs, report), ""))
    except ScanError as error:
        connection.send(("error", error, traceback.format_exc()))


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
