"""Processes of nodes: one each, forked from a server that has the heavy libraries loaded; they end with their run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import traceback
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.engine.ready_queue import Watch
from scan2sim.flows.engine.run_task import run_node
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, StepError

TRACKER = "ignore:resource_tracker"
"""A filter of warnings for Python's own process that clears up after killed ones, and says so."""
SAID = 10_000
"""Bytes of what a failed step's libraries printed that go into the log."""


def _processes() -> Any:
    """Processes forked from a server that has the heavy libraries loaded."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # several nodes share the cores: don't spin
    if TRACKER not in sys.warnoptions:
        sys.warnoptions.append(TRACKER)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["scan2sim.flows.engine.forkserver_preload"])
    # Ctrl-C in a terminal reaches the server as well: until it is ready, it would die of it, and say so at length
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def start(item: Planned, store: Store) -> tuple[Connection, ForkServerProcess]:
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


def receive(connection: Connection, item: Planned, process: ForkServerProcess, watch: Watch) -> Manifest | None:
    """Handle one message of a node; its manifest once it is done."""
    try:
        kind, value, message = connection.recv()
    except EOFError:
        process.join()
        cause = "was killed, probably for want of memory" if process.exitcode == -signal.SIGKILL else "crashed"
        raise StepError(
            item.node.full_name,
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


def stop(process: ForkServerProcess) -> None:
    """End a node's process and whatever it has started."""
    if process.pid is None or not process.is_alive():
        return
    process.terminate()
    process.join(2)
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()
