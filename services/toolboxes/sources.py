"""Sources of images: folders, videos and cameras, each read by a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.types import U8
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
"""Ends of files' names that a folder is searched for."""
LONGEST_PAUSE = 5.0
"""Seconds between two tries to reach a camera, at most."""
SILENT = 5.0
"""Seconds without an image after which a camera counts as gone."""


@dataclass(frozen=True)
class Shot:
    """An image of a folder or a video.

    Attributes:
        name: of its file, or its number in the video.
        stamp: nanoseconds since the video began; None for a folder's.
        image: encoded, or (H, W, 3) RGB.
    """

    name: str
    stamp: int | None
    image: bytes | U8


def is_camera(address: str) -> bool:
    """Whether it is a camera's, no file's: rtsp://..., http://..., or a device's number."""
    return "://" in address or address.isdecimal()


def rate_of(path: Path) -> float | None:
    """Images a second of a video; None for pictures."""
    import cv2

    return None if _is_pictures(path) else cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS) or None


def count(path: Path) -> int:
    """Images of a folder or video, about.

    Raises:
        InputError: there are none.
    """
    import cv2

    if _is_pictures(path):
        return len(_pictures(path))
    return max(1, int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)))


def shots(path: Path) -> Iterator[Shot]:
    """Images of a folder, of a picture alone, or of a video, in order.

    Raises:
        InputError: there are none, or it can't be read.
    """
    if _is_pictures(path):
        for picture in _pictures(path):
            yield Shot(picture.name, None, picture.read_bytes())
        return
    import cv2

    video = cv2.VideoCapture(str(path))
    rate, number = video.get(cv2.CAP_PROP_FPS) or 25.0, 0
    while (image := _read(video)) is not None:
        yield Shot(f"{number:06}", round(number / rate * 1e9), image)
        number += 1
    if number == 0:
        raise InputError(path, "is no video that can be read", "Give a folder of pictures, a picture or a video")


def images(path: Path) -> Iterator[U8]:
    """(H, W, 3) RGB of all of them.

    Raises:
        InputError: there are none, or one can't be decoded.
    """
    for shot in shots(path):
        yield frames.rgb(Frame(shot.name, str(path), shot.stamp, shot.image, lambda _: None))


def _is_pictures(path: Path) -> bool:
    if not path.exists():
        raise InputError(path, "is not there", "Give a folder of pictures, a picture or a video")
    return path.is_dir() or path.suffix.lower() in PICTURES


def _pictures(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    found = sorted(one for one in path.iterdir() if one.suffix.lower() in PICTURES)
    if not found:
        raise InputError(path, f"holds no {', '.join(PICTURES)}", "Give a folder of pictures, a picture or a video")
    return found


def _read(video: Any) -> U8 | None:
    good, image = video.read()
    return np.ascontiguousarray(image[..., ::-1]) if good else None


class Cameras:
    """Reads cameras, a thread each, and keeps the last result of each; a camera that is gone is looked for again."""

    def __init__(self, engine: Engine, addresses: list[str]) -> None:
        """Of an engine; addresses as OpenCV takes them: rtsp://..., http://..., a device's number, a file."""
        self._readers = [_Camera(engine, address) for address in addresses]

    def start(self) -> None:
        """Read from now on."""
        for reader in self._readers:
            reader.start()

    def stop(self) -> None:
        """Read nothing."""
        for reader in self._readers:
            reader.stop()

    def running(self) -> bool:
        """Whether they are read."""
        return any(reader.running() for reader in self._readers)

    def last(self, source: str | None = None) -> list[Result]:
        """The last result of each camera, or of one."""
        return [one.last for one in self._readers if one.last and source in (None, one.address)]

    def states(self) -> dict[str, dict[str, Any]]:
        """By address, whether it sends images, and how many it did."""
        return {one.address: {"there": one.is_there(), "images": one.count} for one in self._readers}


class Reader:
    """Reads a camera in a thread of its own; one that is gone is looked for again.

    Attributes:
        count: images that came.
    """

    def __init__(self, address: str, take: Callable[[U8], None]) -> None:
        """Of an address as OpenCV takes it; `take` is given each image, (H, W, 3) RGB, in that thread."""
        self._address, self._take = address, take
        self.count, self._seen = 0, 0.0
        self._stopped, self._thread = threading.Event(), threading.Thread()

    def start(self) -> None:
        """Read from now on."""
        if not self.running():
            self._stopped = threading.Event()
            self._thread = threading.Thread(target=self._run, args=(self._stopped,), name=self._address, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Read nothing."""
        self._stopped.set()
        if self._thread.ident:
            self._thread.join(SILENT)

    def running(self) -> bool:
        """Whether it is read, or looked for."""
        return self._thread.is_alive() and not self._stopped.is_set()

    def is_there(self) -> bool:
        """Whether it sends images."""
        return self.running() and time.monotonic() - self._seen < SILENT

    def _run(self, stopped: threading.Event) -> None:
        import cv2

        pause = 0.0
        while not stopped.wait(pause):
            video = cv2.VideoCapture(int(self._address) if self._address.isdecimal() else self._address)
            while not stopped.is_set() and (image := _read(video)) is not None:
                pause = 0.0
                self.count += 1
                self._seen = time.monotonic()
                self._take(image)
            video.release()
            pause = min(LONGEST_PAUSE, 2 * pause or 0.2)


class _Camera(Reader):
    """Whose images an engine works on."""

    def __init__(self, engine: Engine, address: str) -> None:
        super().__init__(address, self._submit)
        self._engine, self.address = engine, address
        self.last: Result | None = None

    def stop(self) -> None:
        super().stop()
        self.last = None

    def _submit(self, image: U8) -> None:
        self._engine.submit(Frame(f"{self.count}", self.address, time.time_ns(), image, self._keep))

    def _keep(self, result: Result) -> None:
        if result.body is not None:
            self.last = result
