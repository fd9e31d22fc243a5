"""Processes of tasks: one per task, forked from a server with the heavy libraries loaded; they end with their run."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from scan2sim.flows.engine.main_module import STEP
from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.ready_queue import EventCallback
from scan2sim.flows.engine.run_task import run_task
from scan2sim.pipeline.core.anonymous_file import anonymous_file
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, StepError

TRACKER_WARNING_FILTER = "ignore:resource_tracker"
"""Silences the warnings of Python's resource tracker, which cleans up after killed processes."""
SOCKETS = "/tmp"
"""Folder where sockets can be created if TMPDIR has too long a path for them (108 bytes), or a disk without sockets."""
PACKAGES = Path(__file__).parents[3]
"""Folder that this package is imported from."""
MAX_OUTPUT_BYTES = 10_000
"""Size limit of the output of a failed step's libraries in the log; its end is kept."""

_starting = threading.Lock()


def _fork_server() -> Any:
    """Multiprocessing context of a fork server with the heavy libraries loaded."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["scan2sim.flows.engine.forkserver_preload"])
    with _starting, _environment_of_server():
        # Ctrl-C in a terminal also reaches the server and new children, which would die with a traceback until they are
        # ready: they inherit the blocked signal. Starting the resource tracker, which the server needs, unblocks it.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            try:
                forkserver.ensure_running()
            except OSError:
                _use_folder_for_sockets(SOCKETS)
                forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _use_folder_for_sockets(parent: str) -> None:
    """Let multiprocessing create its sockets in a new folder below `parent`, not in the folder for temporary files."""
    folder = tempfile.mkdtemp(prefix="pymp-", dir=parent)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    multiprocessing.current_process()._config["tempdir"] = folder  # type: ignore[attr-defined]


@contextmanager
def _environment_of_server() -> Iterator[None]:
    """What the server and the resource tracker inherit when they start; this program's own state stays as it was.

    They find this package and the libraries where the program found them, although it may have changed `sys.path`, and
    no module in its working folder (a `random.py`) shadows the standard library.
    """
    folders = [folder for folder in sys.path if isinstance(folder, str) and folder]
    variables = {
        "OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "passive"),  # several tasks share the cores: don't spin
        "PYTHONPATH": os.pathsep.join([*folders, str(PACKAGES)]),
        "PYTHONSAFEPATH": "1",
    }
    before, filters, path = {name: os.environ.get(name) for name in variables}, sys.warnoptions[:], sys.path[:]
    os.environ.update(variables)
    sys.warnoptions.append(TRACKER_WARNING_FILTER)
    sys.path[:] = folders  # the server can't read what is no text, such as a `Path`
    try:
        yield
    finally:
        sys.warnoptions[:], sys.path[:] = filters, path
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start(item: PlannedTask, store: Store) -> tuple[Connection, ForkServerProcess]:
    """Start a task in a process of its own; returns the connection that its messages come through."""
    # workers of a cluster are daemons, which may not have children; task processes end with them (`_exit_with_parent`)
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    context = _fork_server()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(name=STEP, target=_child, args=(theirs, item, store, item.inputs(store)))
    process.start()
    theirs.close()
    return ours, process


def _child(connection: Connection, item: PlannedTask, store: Store, inputs: dict[str, Path]) -> None:
    """Main function of a task's process: sends ("progress", fraction, message), then ("done" | "error", value, log).

    Output of libraries is captured; it goes into the log if the task fails.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and stops its children
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    os.setpgrp()
    output = anonymous_file()
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    threading.Thread(target=_exit_with_parent, daemon=True).start()

    def report(fraction: float, message: str = "") -> None:
        connection.send(("progress", fraction, message))

    try:
        connection.send(("done", run_task(item, store, inputs, report), ""))
    except ScanError as error:
        output.seek(max(0, output.seek(0, os.SEEK_END) - MAX_OUTPUT_BYTES))
        output_text = output.read().decode(errors="replace")
        connection.send(("error", error, traceback.format_exc() + output_text))


def _exit_with_parent() -> None:
    """Wait for the death of the parent process, then kill this process group: nobody would receive the result."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.killpg(os.getpgrp(), signal.SIGKILL)


def receive(
    connection: Connection, item: PlannedTask, process: ForkServerProcess, on_event: EventCallback
) -> Manifest | None:
    """Handle one message of a task; returns its manifest once it is done, else None.

    Raises:
        ScanError: the task failed, or its process died.
    """
    try:
        kind, value, message = connection.recv()
    except EOFError:
        process.join()
        cause = "was killed, probably because memory ran out" if process.exitcode == -signal.SIGKILL else "crashed"
        raise StepError(
            item.task.full_name,
            f"{cause} (exit status {process.exitcode})",
            "Run again with --jobs 1, or use a smaller tile",
        ) from None
    if kind == "progress":
        on_event(item.task, "progress", value, message)
        return None
    if kind == "error":
        value.add_note(message)
        raise value
    return value


def stop(process: ForkServerProcess) -> None:
    """Terminate a task's process and all processes that it has started."""
    if process.pid is None or not process.is_alive():
        return
    process.terminate()
    process.join(2)
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()
    process.join(10)
