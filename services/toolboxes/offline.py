"""A toolbox over a folder or a video: results as lines of JSON, and pictures or a film with them drawn in."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.services.toolboxes import frames, sources, tasks
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result, State

RESULTS, FILM, PICTURES = "results.jsonl", "film.mp4", "pictures"
"""What is in the folder afterwards: a film of a video, pictures of pictures."""
PATIENT = 3600.0
"""Seconds; files can wait."""


def work_through(engine: Engine, path: Path, out: Path, report: Report, *, draw: bool = True) -> dict[str, int]:
    """Have all images of a folder or a video worked on; returns how many ended in which state.

    Raises:
        InputError: there are none.
        UnavailableError: a film can't be written here.
    """
    total, rate = sources.count(path), sources.rate_of(path)
    out.mkdir(parents=True, exist_ok=True)
    ended: dict[str, int] = {}
    with ExitStack() as stack:
        lines = stack.enter_context((out / RESULTS).open("w"))
        pictures = stack.enter_context(_Pictures(engine.name, out, rate)) if draw else None
        for number, (frame, result) in enumerate(_worked(engine, path)):
            _note(lines, result)
            ended[result.state] = ended.get(result.state, 0) + 1
            if pictures and result.state == State.DONE:
                pictures.add(frame, result)
            report(min(1.0, (number + 1) / total), f"image {number + 1}")
    return ended


def _worked(engine: Engine, path: Path) -> Iterator[tuple[Frame, Result]]:
    """Frames with their results, in the frames' order; a few are on their way at a time."""
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

    for shot in sources.shots(path):
        frame = Frame(shot.name, str(path), shot.stamp, shot.image, answers.put)
        sent[shot.name] = frame
        while not engine.submit_when_free(frame, 1.0):
            yield from ready(block=False)
        yield from ready(block=False)
    yield from ready(block=True)


def _note(lines: IO[str], result: Result) -> None:
    lines.write(result.json_line() + "\n")


class _Pictures:
    """Pictures, or a film, of results."""

    def __init__(self, box: str, out: Path, rate: float | None) -> None:
        self._box, self._out, self._rate = tasks.find(box), out, rate
        self._film: Encoder | None = None
        self._count = 0

    def __enter__(self) -> _Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        if self._film:
            self._film.close()

    def add(self, frame: Frame, result: Result) -> None:
        """Draw a result."""
        import cv2

        assert result.body
        drawn = self._box.draw(frames.rgb(frame), result.body)
        if self._rate is None:
            folder = self._out / PICTURES
            folder.mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"{Path(frame.id).stem}.jpg"), drawn[..., ::-1])
            return
        self._add_to_film(np.ascontiguousarray(drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2]))

    def _add_to_film(self, image: U8) -> None:
        import cv2

        assert self._rate
        if self._film is None:
            size = (image.shape[1], image.shape[0])
            self._film = Encoder(self._out / FILM, size, self._rate, preset="veryfast", crf="23")
        yuv: Any = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
        self._film.add(yuv, self._count / self._rate)
        self._count += 1
