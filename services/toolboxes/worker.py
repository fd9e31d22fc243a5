"""A toolbox's model in a process of its own: where it dies or hangs, the toolbox lives, and starts it anew."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import ScanError, StepError
from scan2sim.pipeline.core.sandbox import die_with_parent
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import tasks
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Facts

LOADS_WITHIN = 300.0
"""Seconds for a model to be loaded and to answer its first image."""
ENDS_WITHIN = 2.0
PROBE = np.zeros((64, 64, 3), np.uint8)
"""An image that a model must answer before it counts as ready."""


class WorkerDied(Exception):
    """The process is gone, or hangs."""


class Worker:
    """Runs a model; of one thread."""

    def __init__(self, box: str, params: ToolboxParams) -> None:
        """Start it, and wait until the model has answered.

        Raises:
            ScanError: as `boxes.Toolbox.load`.
            WorkerDied: it died meanwhile.
        """
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, box, params), name=box, daemon=True)
        self._process.start()
        theirs.close()
        self._hangs = params.hangs
        try:
            self.facts: Facts = self._answer(LOADS_WITHIN)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the process is there."""
        return self._process.is_alive()

    def infer(self, images: Sequence[U8]) -> list[Body]:
        """What the model says of each image.

        Raises:
            ScanError: the model failed at one of them.
            WorkerDied: it is gone, or didn't answer in time and was killed; another must be made.
        """
        try:
            self._connection.send(list(images))
        except OSError as error:
            raise WorkerDied(f"the model's process is gone ({error})") from None
        answered: list[Body] = self._answer(self._hangs)
        return answered

    def _answer(self, timeout: float) -> Any:
        try:
            if not self._connection.poll(timeout):
                self._process.kill()
                raise WorkerDied(f"the model didn't answer within {timeout:g} s")
            answer = self._connection.recv()
        except (EOFError, OSError):
            self._process.join(ENDS_WITHIN)
            raise WorkerDied(f"the model's process ended ({self._process.exitcode})") from None
        if isinstance(answer, ScanError):
            raise answer
        return answer

    def kill(self) -> None:
        """End it at once; may be called from any thread."""
        self._process.kill()

    def close(self) -> None:
        """End it."""
        self._connection.close()
        self._process.join(ENDS_WITHIN)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(connection: Connection, box: str, params: ToolboxParams) -> None:
    """Answer lists of images until there is nobody who sends any."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the toolbox, which then closes the connection
    if params.threads:
        os.environ["OMP_NUM_THREADS"] = str(params.threads)
    with contextlib.suppress(EOFError, OSError):  # the toolbox has ended
        try:
            model = tasks.find(box).load(params)
            model([PROBE])
        except ScanError as error:
            connection.send(error)
            return
        connection.send(model.facts)
        while True:
            connection.send(_answered(model, connection.recv(), box))


def _answered(model: tasks.Model, images: list[U8], box: str) -> list[Body] | ScanError:
    try:
        return model(images)
    except ScanError as error:
        return error
    except Exception as error:  # whatever a model raises, the next image is another
        sizes = ", ".join(f"{one.shape[1]} x {one.shape[0]}" for one in images)
        return StepError(box, f"failed on {sizes} ({type(error).__name__}: {error})", "Send another image")
