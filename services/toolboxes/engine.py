"""The way of a frame through a toolbox: it waits, is decoded, goes through the model, is followed, and is answered.

    reader -> Waiting -> dispatcher (batches, decodes) -> Worker (the model) -> Follower of its source -> answer

All lines are bounded: where frames come faster than they can be worked on, each source's oldest are dropped. Whatever
becomes of a frame, its sender gets one answer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import ScanError, UnavailableError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.toolboxes import frames, tasks
from scan2sim.services.toolboxes.frame_queue import SOURCES, Waiting
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.per_source_worker import Follower
from scan2sim.services.toolboxes.results import Body, Result, State, Times
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Facts
from scan2sim.services.toolboxes.worker import Worker, WorkerDied

log = logging.getLogger(__name__)

TICK = 0.1
"""Seconds between two looks at whether the worker lives."""
ENDS_WITHIN = 2.0
"""Seconds that the model has for what it has begun, when the toolbox ends."""
LONGEST_PAUSE = 5.0
"""Seconds between two starts of a worker that dies at once, at most."""
FORGOTTEN = 60.0
"""Seconds without a frame after which a source's follower, and what it remembers, is gone."""
RECENT = 0.2
"""Weight of the last batch in the mean time of one, and in how far times are from it."""
CAUTION = 3.0
"""So many times that distance longer than the mean a batch is thought to take (as Jacobson's timeouts, 1988)."""


@dataclass(frozen=True)
class _Work:
    frame: Frame
    image: U8
    begun: float


class Engine:
    """Runs a toolbox; may be used from any thread.

    Attributes:
        name: of the toolbox.
        facts: of its model.
        counts: frames by what became of them (`State`); "received", all of them; "restarts" of the model.
    """

    def __init__(self, box: str, params: ToolboxParams) -> None:
        """Load the model, and wait for frames.

        Raises:
            ScanError: it can't be loaded.
        """
        self.name, self._params, self._box = box, params, tasks.find(box)
        self._box.check(params)
        self.counts: Counter[str] = Counter()
        self._counting, self._closed = threading.Lock(), threading.Event()
        self._waiting = Waiting(params.waiting)
        self._followers: dict[str, Follower] = {}
        self._typical = self._spread = 0.0
        try:
            self._worker: Worker | None = Worker(box, params)
        except WorkerDied as error:
            raise UnavailableError(box, str(error), "Its weights may need more memory than there is") from None
        self.facts: Facts = self._worker.facts
        self._dispatcher = threading.Thread(target=self._dispatch, name=f"{box} dispatcher", daemon=True)
        self._dispatcher.start()

    def submit(self, frame: Frame) -> None:
        """Have a frame worked on; its source's oldest is dropped if too many wait."""
        self._count("received")
        dropped = self._waiting.put(frame)
        if dropped is not None:
            self._answer(dropped, State.DROPPED, "newer images came faster than they can be worked on")

    def submit_when_free(self, frame: Frame, timeout: float) -> bool:
        """Have a frame worked on once there is room; False: there was none within so many seconds."""
        taken = self._waiting.put_when_free(frame, timeout)
        if taken:
            self._count("received")
        return taken

    def is_alive(self) -> bool:
        """Whether frames are worked on, or will be once the model is back."""
        return self._dispatcher.is_alive()

    def is_ready(self) -> bool:
        """Whether the model is there, and answered its first image."""
        worker = self._worker
        return worker is not None and worker.is_alive()

    def pid(self) -> int | None:
        """Of the model's process; None while it is started anew."""
        worker = self._worker
        return worker.pid if worker else None

    def typical(self) -> float:
        """Seconds that a batch takes, lately."""
        return self._typical

    def waiting(self) -> tuple[int, float]:
        """Frames that wait, and seconds that the oldest has."""
        return len(self._waiting), self._waiting.oldest()

    def close(self) -> None:
        """End; frames that wait are dropped."""
        self._closed.set()
        for frame in self._waiting.close():
            self._answer(frame, State.DROPPED, "the toolbox ends")
        self._dispatcher.join(ENDS_WITHIN)
        if self._dispatcher.is_alive() and self._worker:
            self._worker.kill()  # it hangs, or takes long
        self._dispatcher.join()
        for follower in self._followers.values():
            follower.close()
        if self._worker:
            self._worker.close()

    def _dispatch(self) -> None:
        linger = self._params.linger if self._params.batch > 1 else 0.0
        while not self._closed.is_set():
            if not self.is_ready():
                self._restart()
            batch = [self._prepared(frame) for frame in self._waiting.take(self._params.batch, TICK, linger)]
            if works := [one for one in batch if one]:
                self._work(works)
            self._forget(0, FORGOTTEN)

    def _prepared(self, frame: Frame) -> _Work | None:
        """Decoded, unless it is late or can't be."""
        if frame.age() + self._typical + CAUTION * self._spread > self._params.deadline:
            self._typical, self._spread = (1 - RECENT) * self._typical, (1 - RECENT) * self._spread  # soon another try
            self._answer(frame, State.LATE, f"waited {frame.age():.2f} s of {self._params.deadline:g} s")
            return None
        begun = time.monotonic()
        try:
            return _Work(frame, frames.rgb(frame), begun)
        except ScanError as error:
            self._answer(frame, State.REFUSED, f"{error.cause}. {error.remedy}")
            return None

    def _work(self, works: list[_Work]) -> None:
        """Have a batch answered; where the model fails or dies over it, each frame is tried alone."""
        try:
            bodies: list[Body | str] = list(self._inferred(works))
        except ScanError:
            bodies = [self._alone(one) for one in works]
        except WorkerDied as error:
            self._restart(error)
            bodies = [self._alone(one) for one in works]
        for one, body in zip(works, bodies, strict=True):
            self._hand_on(one, body)

    def _alone(self, one: _Work) -> Body | str:
        try:
            return self._inferred([one])[0]
        except ScanError as error:
            return f"{error.cause}. {error.remedy}"
        except WorkerDied as error:
            self._restart(error)
            return str(error)

    def _inferred(self, works: list[_Work]) -> list[Body]:
        if self._worker is None:
            raise WorkerDied("the model is away")
        begun = time.monotonic()
        bodies = self._worker.infer([one.image for one in works])
        took = time.monotonic() - begun
        self._spread += RECENT * (abs(took - self._typical) - self._spread) if self._typical else 0.0
        self._typical += (RECENT if self._typical else 1.0) * (took - self._typical)
        return bodies

    def _restart(self, cause: object = "the model's process ended") -> None:
        """Start the model anew; returns when it is there, or the toolbox ends."""
        log.warning("%s: %s; the model is started anew", self.name, cause)
        if self._worker:
            self._worker.close()
            self._worker = None
        pause = TICK
        while not self._closed.is_set():
            self._count("restarts")
            try:
                self._worker = Worker(self.name, self._params)
                return
            except (ScanError, WorkerDied) as error:
                log.error("%s: %s", self.name, error)
            self._closed.wait(pause)
            pause = min(LONGEST_PAUSE, 2 * pause)

    def _hand_on(self, one: _Work, body: Body | str) -> None:
        """To the follower of its source, if the toolbox follows, else to who sent it."""
        source = one.frame.source
        if isinstance(body, Body) and source not in self._followers:
            follow = self._box.follow(self._params)
            if follow is not None:
                self._forget(SOURCES - 1, 0.0)
                self._followers[source] = Follower(source, follow)
        if isinstance(body, Body) and source in self._followers:
            self._followers[source].put(one.frame, one.image, body, lambda followed: self._done(one, followed))
        else:
            self._done(one, body)

    def _forget(self, most: int, idle: float) -> None:
        """End followers of sources that had no frame for so many seconds, while there are more than `most`."""
        for source in sorted(self._followers, key=lambda name: -self._followers[name].idle()):
            if len(self._followers) > most and self._followers[source].idle() >= idle:
                self._followers.pop(source).close()

    def _done(self, one: _Work, body: Body | str) -> None:
        if isinstance(body, str):
            self._answer(one.frame, State.FAILED, body, one)
        else:
            self._answer(one.frame, State.DONE, None, one, body)

    def _answer(
        self, frame: Frame, state: State, error: str | None, work: _Work | None = None, body: Body | None = None
    ) -> None:
        self._count(state)
        result = Result(
            toolbox=self.name,
            model=self.facts.name,
            id=frame.id,
            source=redacted(frame.source),
            stamp=frame.stamp,
            state=state,
            size=(work.image.shape[1], work.image.shape[0]) if work else None,
            body=body,
            times=Times(waited=work.begun - frame.received, worked=time.monotonic() - work.begun) if work else None,
            error=error and redacted(error),
        )
        try:
            frame.answer(result)
        except Exception:  # who asked is gone; the others aren't
            log.exception("%s: the result of %s could not be delivered", self.name, frame.id)

    def _count(self, what: str) -> None:
        with self._counting:
            self.counts[what] += 1
