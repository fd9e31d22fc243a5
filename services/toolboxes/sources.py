"""Sources of images: folders, videos and cameras, each read by a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result

log = logging.getLogger(__name__)

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
"""Ends of files' names that a folder is searched for."""
REMEDY = "Give a folder of pictures, a picture or a video"
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
        raise InputError(redacted(str(path)), "is no video that can be read", REMEDY)


def images(path: Path) -> Iterator[U8]:
    """(H, W, 3) RGB of all of them.

    Raises:
        InputError: there are none, or one can't be decoded.
    """
    for shot in shots(path):
        yield frames.rgb(Frame(shot.name, str(path), shot.stamp, shot.image, lambda _: None))


def _is_pictures(path: Path) -> bool:
    if not path.exists():
        raise InputError(redacted(str(path)), "is not there", REMEDY)
    return path.is_dir() or path.suffix.lower() in PICTURES


def _pictures(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    found = sorted(one for one in path.iterdir() if one.suffix.lower() in PICTURES)
    if not found:
        raise InputError(path, f"holds no {', '.join(PICTURES)}", REMEDY)
    return found


def _read(video: Any) -> U8 | None:
    good, image = video.read()
    return np.ascontiguousarray(image[..., ::-1]) if good else None


class Cameras:
    """Reads cameras, a thread each, and keeps the last result of each; a camera that is gone is looked for again."""

    def __init__(self, engine: Engine, addresses: list[str]) -> None:
        """Of an engine; addresses as OpenCV takes them: rtsp://..., http://..., a device's number, a file.

        Results, states and logs name a camera by its address without credentials.
        """
        self._readers = [_Camera(engine, *named) for named in zip(addresses, names(addresses), strict=True)]

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
        """The last result of each camera, or of one, by its name or its address."""
        wanted = source and redacted(source)
        return [one.last for one in self._readers if one.last and wanted in (None, one.name)]

    def states(self) -> dict[str, dict[str, Any]]:
        """By camera's name, whether it sends images, and how many it did."""
        return {one.name: {"there": one.is_there(), "images": one.count} for one in self._readers}


def names(addresses: Sequence[str]) -> list[str]:
    """Addresses without credentials; the second and further ones that look alike then are numbered."""
    seen: Counter[str] = Counter()
    found = []
    for name in map(redacted, addresses):
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return found


class Reader:
    """Reads a camera in a thread of its own; one that is gone is looked for again.

    Attributes:
        name: address without credentials, unless another is given.
        count: images that came.
    """

    def __init__(self, address: str, take: Callable[[U8], None], name: str = "") -> None:
        """Of an address as OpenCV takes it; `take` is given each image, (H, W, 3) RGB, in that thread."""
        self._address, self._take, self.name = address, take, name or redacted(address)
        self.count, self._seen = 0, 0.0
        self._stopped, self._thread = threading.Event(), threading.Thread()

    def start(self) -> None:
        """Read from now on."""
        if not self.running():
            self._stopped = threading.Event()
            self._thread = threading.Thread(target=self._run, args=(self._stopped,), name=self.name, daemon=True)
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

        pause, warned = 0.0, False
        while not stopped.wait(pause):
            before = self.count
            video = cv2.VideoCapture(int(self._address) if self._address.isdecimal() else self._address)
            while not stopped.is_set() and (image := _read(video)) is not None:
                pause = 0.0
                self.count += 1
                self._seen = time.monotonic()
                self._take(image)
            video.release()
            if self.count == before and not warned and not stopped.is_set():
                log.warning("%s gives no images: check its address and that it runs; it is tried again", self.name)
            warned = self.count == before
            pause = min(LONGEST_PAUSE, 2 * pause or 0.2)


class _Camera(Reader):
    """Whose images an engine works on."""

    def __init__(self, engine: Engine, address: str, name: str) -> None:
        super().__init__(address, self._submit, name)
        self._engine = engine
        self.last: Result | None = None

    def stop(self) -> None:
        super().stop()
        self.last = None

    def _submit(self, image: U8) -> None:
        self._engine.submit(Frame(f"{self.count}", self.name, time.time_ns(), image, self._keep))

    def _keep(self, result: Result) -> None:
        if result.body is not None:
            self.last = result
