"""Offline processing of a folder or a video: results as JSON lines, and images or a video with the results drawn."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.services.toolboxes import frames, sources, tasks
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result, State

RESULTS_FILE, VIDEO_FILE, IMAGES_FOLDER = "results.jsonl", "film.mp4", "pictures"
"""Names in the output folder: drawn results are a video for a video, images for images."""
OFFLINE_DEADLINE_S = 3600.0
"""Deadline of a frame: files have no real-time requirement."""


def process_files(engine: Engine, path: Path, out: Path, report: Report, *, draw: bool = True) -> dict[str, int]:
    """Process all images of a folder or a video; returns the number of images by final state.

    Raises:
        InputError: there are no images.
        UnavailableError: no video encoder is available.
    """
    total, rate = sources.count(path), sources.rate_of(path)
    out.mkdir(parents=True, exist_ok=True)
    ended: dict[str, int] = {}
    with ExitStack() as stack:
        lines = stack.enter_context((out / RESULTS_FILE).open("w", encoding="utf-8"))
        drawings = stack.enter_context(_DrawnResults(engine.name, out, rate)) if draw else None
        for number, (frame, result) in enumerate(_results(engine, path)):
            _write_line(lines, result)
            ended[result.state] = ended.get(result.state, 0) + 1
            if drawings and result.state == State.DONE:
                drawings.add(frame, result)
            report(min(1.0, (number + 1) / total), f"image {number + 1}")
    return ended


def _results(engine: Engine, path: Path) -> Iterator[tuple[Frame, Result]]:
    """Iterate over the frames with their results, in the order of the frames; several are processed concurrently."""
    answers: queue.Queue[Result] = queue.Queue()
    sent: dict[str, Frame] = {}
    done: dict[str, Result] = {}

    def ready(block: bool) -> Iterator[tuple[Frame, Result]]:
        while sent:
            first = next(iter(sent))
            if first in done:
                yield sent.pop(first), done.pop(first)
                continue
            try:
                result = answers.get(block=block)
            except queue.Empty:
                return
            done[result.id] = result

    for stored in sources.stored_images(path):
        frame = Frame(stored.name, str(path), stored.stamp, stored.image, answers.put)
        sent[stored.name] = frame
        while not engine.submit_when_free(frame, 1.0):
            yield from ready(block=False)
        yield from ready(block=False)
    yield from ready(block=True)


def _write_line(lines: IO[str], result: Result) -> None:
    lines.write(result.json_line() + "\n")


class _DrawnResults:
    """Writes images, or a video if `rate` is given, with the results drawn."""

    def __init__(self, task: str, out: Path, rate: float | None) -> None:
        self._task, self._out, self._rate = tasks.find(task), out, rate
        self._video: Encoder | None = None
        self._count = 0

    def __enter__(self) -> _DrawnResults:
        return self

    def __exit__(self, *_: object) -> None:
        if self._video:
            self._video.close()

    def add(self, frame: Frame, result: Result) -> None:
        """Draw a result and write the image."""
        assert result.body
        drawn = self._task.draw(frames.rgb(frame), result.body)
        if self._rate is None:
            folder = self._out / IMAGES_FOLDER
            folder.mkdir(exist_ok=True)
            image.write(folder / f"{Path(frame.id).stem}.jpg", drawn, quality=95)
            return
        self._add_to_video(np.ascontiguousarray(drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2]))

    def _add_to_video(self, image: U8) -> None:
        import cv2

        assert self._rate
        if self._video is None:
            size = (image.shape[1], image.shape[0])
            self._video = Encoder(self._out / VIDEO_FILE, size, self._rate, preset="veryfast", crf="23")
        yuv: Any = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
        self._video.add(yuv, self._count / self._rate)
        self._count += 1
