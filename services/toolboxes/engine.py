"""Inference engine of a toolbox: queues, decodes, batches, runs the model, post-processes and answers each frame.

    reader -> FrameQueue -> dispatcher (batches, decodes) -> ModelProcess -> SourceWorker of the source -> answer

All queues are bounded: when frames arrive faster than they can be processed, the oldest of each source are dropped;
requests of clients are accepted as a whole or not at all.
Every frame gets exactly one answer, whatever happens to it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection

from scan2sim.pipeline.core.errors import ScanError, UnavailableError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.toolboxes import frames, tasks
from scan2sim.services.toolboxes.frame_queue import MAX_SOURCES, FrameQueue
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.per_source_worker import SourceWorker
from scan2sim.services.toolboxes.results import Body, Result, State, Times
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.worker import ModelProcess, ModelProcessDied

log = logging.getLogger(__name__)

POLL_INTERVAL_S = 0.1
"""Pause between two checks whether the model's process is alive."""
STOP_TIMEOUT_S = 2.0
"""Time that the model has for its current batch when the toolbox stops."""
MAX_RESTART_PAUSE_S = 5.0
"""Upper bound of the exponential backoff between restarts of the model's process."""
SOURCE_EXPIRY_S = 60.0
"""The worker of a source, with its state, is closed after so long without a frame."""
SMOOTHING = 0.2
"""Weight of the latest batch in the moving averages of the batch time and its mean deviation."""
DEVIATION_FACTOR = 3.0
"""Predicted batch time: mean plus this multiple of the mean deviation (as in Jacobson's timeouts, 1988)."""


@dataclass(frozen=True)
class _DecodedFrame:
    frame: Frame
    image: U8
    begun: float


class Engine:
    """Runs a toolbox; thread-safe.

    Attributes:
        name: name of the toolbox.
        info: description of its model.
        deadline: seconds from a frame's arrival to its result.
        counts: frames by final `State`; "received": all frames; "beyond_queue": frames of requests that found their
            queue full; "executions": batches; "restarts": restarts of the model.
        seconds: total times of the frames with results: "waited", "worked".
    """

    def __init__(
        self,
        task: str,
        params: ToolboxParams,
        *,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[Connection, float], bool] = Connection.poll,
    ) -> None:
        """Load the model and start the dispatcher.

        Args:
            task: name of the toolbox.
            params: its settings.
            clock: clock of `Frame.received`.
            wait: waits for a response of the model's process for some seconds at most; returns whether there is one.

        Raises:
            ScanError: the model can't be loaded.
        """
        self.name, self._params, self._task = task, params, tasks.find(task)
        self._task.check(params)
        self.deadline = params.deadline
        self.counts: Counter[str] = Counter()
        self.seconds: dict[str, float] = {"waited": 0.0, "worked": 0.0}
        self._clock, self._wait = clock, wait
        self._last_done = clock()
        self._counts_lock, self._closed = threading.Lock(), threading.Event()
        self._queue = FrameQueue(params.waiting, clock=clock)
        self._source_workers: dict[str, SourceWorker] = {}
        self._mean_batch_s = self._batch_deviation_s = 0.0
        try:
            self._model: ModelProcess | None = ModelProcess(task, params, wait=wait)
        except ModelProcessDied as error:
            raise UnavailableError(task, str(error), "The model may need more memory than is available") from None
        self.info: ModelInfo = self._model.info
        self._dispatcher = SupervisedThread(self._dispatch, f"{task} dispatcher")
        self._dispatcher.start()

    def submit(self, frame: Frame) -> None:
        """Queue a frame; if too many of its source are waiting, the oldest is dropped."""
        self._count("received")
        dropped = self._queue.put(frame)
        if dropped is not None:
            self._answer(dropped, State.DROPPED, "newer images arrived faster than they can be processed")

    def submit_when_free(self, frame: Frame, timeout: float) -> bool:
        """Queue a frame when the queue has room; False if it had none within `timeout` seconds."""
        queued = self._queue.put_when_free(frame, timeout)
        if queued:
            self._count("received")
        return queued

    def submit_request(self, request: Sequence[Frame], maximum: int) -> bool:
        """Queue all frames of a request; False, and none is, if more than `maximum` would wait in its queue."""
        queued = self._queue.put_request(request, maximum)
        self._count("received" if queued else "beyond_queue", len(request))
        return queued

    def predicted_wait_s(self) -> float:
        """Predicted time in seconds until the frames that wait now are processed."""
        return len(self._queue) * self._mean_batch_s / self._params.batch

    def idle_s(self) -> float:
        """Seconds since the last frame was processed."""
        return self._clock() - self._last_done

    def is_alive(self) -> bool:
        """Whether frames are processed, now or after a restart of the model."""
        return self._dispatcher.is_alive()

    def is_ready(self) -> bool:
        """Whether the model is loaded and has processed its first image."""
        model = self._model
        return model is not None and model.is_alive()

    def pid(self) -> int | None:
        """Process id of the model; None while it is being restarted."""
        model = self._model
        return model.pid if model else None

    def mean_batch_s(self) -> float:
        """Moving average of the time of a batch, seconds."""
        return self._mean_batch_s

    def waiting(self) -> tuple[int, float]:
        """Number of waiting frames, and waiting time of the oldest in seconds."""
        return len(self._queue), self._queue.oldest()

    def close(self) -> None:
        """Stop; waiting frames are dropped."""
        self._closed.set()
        for frame in self._queue.close():
            self._answer(frame, State.DROPPED, "the toolbox is stopping")
        self._dispatcher.join(STOP_TIMEOUT_S)
        if self._dispatcher.is_alive() and self._model:
            self._model.kill()  # it hangs, or takes too long
        self._dispatcher.join()
        for worker in self._source_workers.values():
            worker.close()
        if self._model:
            self._model.close()

    def _dispatch(self) -> None:
        linger = self._params.linger if self._params.batch > 1 else 0.0
        while not self._closed.is_set():
            if not self.is_ready():
                self._restart()
            taken = self._queue.take(self._params.batch, POLL_INTERVAL_S, linger)
            if batch := [one for frame in taken if (one := self._decode(frame))]:
                self._process(batch)
            self._close_idle_sources(0, SOURCE_EXPIRY_S)

    def _decode(self, frame: Frame) -> _DecodedFrame | None:
        """Decode a frame; None if it would miss its deadline or can't be decoded."""
        if not frame.is_wanted():
            self._answer(frame, State.DROPPED, "nobody waits for the result")
            return None
        deadline = self._params.deadline if frame.deadline is None else frame.deadline
        predicted_s = self._mean_batch_s + DEVIATION_FACTOR * self._batch_deviation_s
        age = self._clock() - frame.received
        if age + predicted_s > deadline:
            self._mean_batch_s *= 1 - SMOOTHING  # decay, so that the model is tried again soon
            self._batch_deviation_s *= 1 - SMOOTHING
            cause = f"waited {age:.2f} s, the deadline is {deadline:g} s"
            self._answer(frame, State.LATE, cause)
            return None
        begun = self._clock()
        try:
            return _DecodedFrame(frame, frames.rgb(frame), begun)
        except ScanError as error:
            self._answer(frame, State.REJECTED, f"{error.cause}. {error.remedy}")
            return None

    def _process(self, batch: list[_DecodedFrame]) -> None:
        """Run the model on a batch; if it fails or dies, run it on each frame separately."""
        try:
            bodies: list[Body | str] = list(self._infer(batch))
        except ScanError:
            bodies = [self._infer_one(one) for one in batch]
        except ModelProcessDied as error:
            self._restart(error)
            bodies = [self._infer_one(one) for one in batch]
        for one, body in zip(batch, bodies, strict=True):
            self._post_process(one, body)

    def _infer_one(self, one: _DecodedFrame) -> Body | str:
        """Result of one frame, or the error message."""
        try:
            return self._infer([one])[0]
        except ScanError as error:
            return f"{error.cause}. {error.remedy}"
        except ModelProcessDied as error:
            self._restart(error)
            return str(error)

    def _infer(self, batch: list[_DecodedFrame]) -> list[Body]:
        if self._model is None:
            raise ModelProcessDied("the model is not running")
        begun = self._clock()
        bodies = self._model.infer([one.image for one in batch])
        self._count("executions")
        took, mean = self._clock() - begun, self._mean_batch_s
        if mean:
            self._batch_deviation_s += SMOOTHING * (abs(took - mean) - self._batch_deviation_s)
        self._mean_batch_s += (SMOOTHING if mean else 1.0) * (took - mean)
        return bodies

    def _restart(self, cause: object = "the model's process ended") -> None:
        """Restart the model; returns when it is loaded, or the toolbox stops."""
        log.warning("%s: %s; restarting the model", self.name, cause)
        if self._model:
            self._model.close()
            self._model = None
        pause = POLL_INTERVAL_S
        while not self._closed.is_set():
            self._count("restarts")
            try:
                self._model = ModelProcess(self.name, self._params, wait=self._wait)
                return
            except (ScanError, ModelProcessDied) as error:
                log.error("%s: %s", self.name, error)
            self._closed.wait(pause)
            pause = min(MAX_RESTART_PAUSE_S, 2 * pause)

    def _post_process(self, one: _DecodedFrame, body: Body | str) -> None:
        """Pass a result to the worker of its source if the toolbox post-processes results, else to the sender."""
        source = one.frame.source
        if isinstance(body, Body) and source not in self._source_workers:
            post_processor = self._task.post_processor(self._params)
            if post_processor is not None:
                self._close_idle_sources(MAX_SOURCES - 1, 0.0)
                self._source_workers[source] = SourceWorker(source, post_processor)
        if isinstance(body, Body) and source in self._source_workers:
            self._source_workers[source].put(one.frame, one.image, body, lambda outcome: self._finish(one, outcome))
        else:
            self._finish(one, body)

    def _close_idle_sources(self, keep: int, min_idle_s: float) -> None:
        """Close workers of sources idle for at least `min_idle_s`, longest idle first, while more than `keep` exist."""
        for source in sorted(self._source_workers, key=lambda name: -self._source_workers[name].idle()):
            if len(self._source_workers) > keep and self._source_workers[source].idle() >= min_idle_s:
                self._source_workers.pop(source).close()

    def _finish(self, one: _DecodedFrame, body: Body | str) -> None:
        if isinstance(body, str):
            self._answer(one.frame, State.FAILED, body, one)
        else:
            self._answer(one.frame, State.DONE, None, one, body)

    def _answer(
        self,
        frame: Frame,
        state: State,
        error: str | None,
        decoded: _DecodedFrame | None = None,
        body: Body | None = None,
    ) -> None:
        times = None
        if decoded:
            times = Times(waited=decoded.begun - frame.received, worked=self._clock() - decoded.begun)
        if times and state == State.DONE:
            self._last_done = self._clock()
            with self._counts_lock:
                self.seconds["waited"] += times.waited
                self.seconds["worked"] += times.worked
        self._count(state)
        result = Result(
            toolbox=self.name,
            model=self.info.name,
            id=frame.id,
            source=redacted(frame.source),
            stamp=frame.stamp,
            state=state,
            size=(decoded.image.shape[1], decoded.image.shape[0]) if decoded else None,
            body=body,
            times=times,
            error=error and redacted(error),
        )
        try:
            frame.answer(result)
        except Exception:  # a client that is gone must not stop the others
            log.exception("%s: the result of %s could not be delivered", self.name, frame.id)

    def _count(self, key: str, number: int = 1) -> None:
        with self._counts_lock:
            self.counts[key] += number
