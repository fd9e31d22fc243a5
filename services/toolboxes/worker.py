"""Model of a toolbox in its own process, so that the toolbox survives a crash or hang and can restart it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import ScanError, StepError
from scan2sim.pipeline.core.sandbox import die_with_parent
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import tasks
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.settings import ToolboxParams

LOAD_TIMEOUT_S = 300.0
"""Time for a model to load and process the probe image."""
STOP_TIMEOUT_S = 2.0
PROBE_IMAGE = np.zeros((64, 64, 3), np.uint8)
"""Image that a model must process before it counts as ready."""


class ModelProcessDied(Exception):
    """The process has ended, or hung and was killed."""


class ModelProcess:
    """Process that runs a model; not thread-safe."""

    def __init__(
        self, task: str, params: ToolboxParams, *, wait: Callable[[Connection, float], bool] = Connection.poll
    ) -> None:
        """Start the process and wait until the model is ready.

        Args:
            task: name of the toolbox.
            params: its settings.
            wait: waits for a response for some seconds at most; returns whether there is one.

        Raises:
            ScanError: raised by `tasks.Toolbox.load`.
            ModelProcessDied: the process died while loading.
        """
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end, task, params), name=task, daemon=True)
        self._process.start()
        child_end.close()
        self._hangs, self._wait = params.hangs, wait
        try:
            self.info: ModelInfo = self._receive(LOAD_TIMEOUT_S)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int | None:
        """Process id."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the process is running."""
        return self._process.is_alive()

    def infer(self, images: Sequence[U8]) -> list[Body]:
        """Run the model on a batch of images.

        Raises:
            ScanError: the model failed on one of them.
            ModelProcessDied: the process has ended, or timed out and was killed; create a new one.
        """
        try:
            self._connection.send(list(images))
        except OSError as error:
            raise ModelProcessDied(f"the model's process has ended ({error})") from None
        bodies: list[Body] = self._receive(self._hangs)
        return bodies

    def _receive(self, timeout: float) -> Any:
        try:
            if not self._wait(self._connection, timeout):
                self._process.kill()
                raise ModelProcessDied(f"the model didn't respond within {timeout:g} s")
            response = self._connection.recv()
        except (EOFError, OSError):
            self._process.join(STOP_TIMEOUT_S)
            raise ModelProcessDied(f"the model's process ended with exit code {self._process.exitcode}") from None
        if isinstance(response, ScanError):
            raise response
        return response

    def kill(self) -> None:
        """Kill the process; thread-safe."""
        self._process.kill()

    def close(self) -> None:
        """Stop the process."""
        self._connection.close()
        self._process.join(STOP_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(connection: Connection, task: str, params: ToolboxParams) -> None:
    """Main function of the process: process batches of images until the connection is closed."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the toolbox, which closes the connection
    if params.threads:
        os.environ["OMP_NUM_THREADS"] = str(params.threads)
    with contextlib.suppress(EOFError, OSError):  # the toolbox closed the connection
        try:
            model = tasks.find(task).load(params)
            model([PROBE_IMAGE])
        except ScanError as error:
            connection.send(error)
            return
        connection.send(model.info)
        while True:
            connection.send(_infer(model, connection.recv(), task))


def _infer(model: tasks.Model, images: list[U8], task: str) -> list[Body] | ScanError:
    try:
        return model(images)
    except ScanError as error:
        return error
    except Exception as error:  # a failure must not affect the next images
        sizes = ", ".join(f"{one.shape[1]} x {one.shape[0]}" for one in images)
        return StepError(task, f"failed on {sizes} ({type(error).__name__}: {error})", "Send another image")
