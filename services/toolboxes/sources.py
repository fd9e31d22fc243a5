"""Image sources: folders, videos, and cameras with a reader thread each."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError, ScanError
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images import image as photos
from scan2sim.services.credentials import redacted
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result

log = logging.getLogger(__name__)

ENCODED_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
"""Files with these suffixes are passed on as they are; other images are decoded here."""
REMEDY = "Give a folder of images, an image or a video"
MAX_RETRY_PAUSE_S = 5.0
"""Upper bound of the exponential backoff between attempts to connect to a camera."""
CAMERA_TIMEOUT_S = 5.0
"""A camera without an image for so long counts as unavailable."""


@dataclass(frozen=True)
class StoredImage:
    """An image of a folder or a video.

    Attributes:
        name: file name, or frame number in the video.
        stamp: nanoseconds since the start of the video; None in a folder.
        image: encoded bytes, or (H, W, 3) RGB.
    """

    name: str
    stamp: int | None
    image: bytes | U8


def is_camera(address: str) -> bool:
    """Whether an address is that of a camera, not a file: rtsp://..., http://..., or a device number."""
    return "://" in address or address.isdecimal()


def rate_of(path: Path) -> float | None:
    """Frame rate of a video in Hz; None for images."""
    import cv2

    return None if _holds_images(path) else cv2.VideoCapture(str(path.absolute())).get(cv2.CAP_PROP_FPS) or None


def count(path: Path) -> int:
    """Approximate number of images in a folder or video.

    Raises:
        InputError: there are no images.
    """
    import cv2

    if _holds_images(path):
        return len(_image_files(path))
    return max(1, int(cv2.VideoCapture(str(path.absolute())).get(cv2.CAP_PROP_FRAME_COUNT)))


def stored_images(path: Path) -> Iterator[StoredImage]:
    """Iterate over the images of a folder, a single image, or the frames of a video, in order.

    Raises:
        InputError: there are no images, or the file can't be read.
    """
    if _holds_images(path):
        for file in _image_files(path):
            yield StoredImage(file.name, None, _content(file))
        return
    import cv2

    video = cv2.VideoCapture(str(path.absolute()))
    rate, number = video.get(cv2.CAP_PROP_FPS) or 25.0, 0
    while (image := _read(video)) is not None:
        yield StoredImage(f"{number:06}", round(number / rate * 1e9), image)
        number += 1
    if number == 0:
        raise InputError(redacted(str(path)), "can't be read as a video", REMEDY)


def decoded_images(path: Path) -> Iterator[U8]:
    """Iterate over the decoded images (H, W, 3) RGB of a folder or video.

    Raises:
        InputError: there are no images, or one can't be decoded.
    """
    for stored in stored_images(path):
        yield frames.rgb(Frame(stored.name, str(path), stored.stamp, stored.image, lambda _: None))


def _holds_images(path: Path) -> bool:
    """Whether a path is a folder or an image, not a video."""
    if not path.exists():
        raise InputError(redacted(str(path)), "not found", REMEDY)
    return path.is_dir() or path.suffix.lower() in photos.SUFFIXES


def _image_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    files = file_checks.files(path)
    found = [one for one in files if one.suffix.lower() in photos.SUFFIXES]
    if not found:
        raise InputError(path, f"contains no {', '.join(photos.SUFFIXES)} files", REMEDY)
    if others := sorted({one.suffix.lower() or one.name for one in files if one not in found}):
        log.warning("%s: %d files are skipped (%s)", path, len(files) - len(found), ", ".join(others)[:200])
    return found


def _content(file: Path) -> bytes | U8:
    """An image as the toolbox takes it: encoded, or (H, W, 3) RGB if its format is one that only photos have."""
    if file.suffix.lower() not in ENCODED_SUFFIXES:
        with suppress(ScanError):  # reported when it is decoded
            return photos.read_rgb(file)
    return file.read_bytes()


def _read(video: Any) -> U8 | None:
    success, image = video.read()
    return np.ascontiguousarray(image[..., ::-1]) if success else None


class Cameras:
    """Reads cameras in a thread each, submits their images to an engine and stores the latest result of each."""

    def __init__(self, engine: Engine, addresses: list[str]) -> None:
        """Create the readers.

        Args:
            engine: processes the images.
            addresses: as OpenCV accepts them: rtsp://..., http://..., a device number, a file. Results, states and logs
                name a camera by its address without credentials.
        """
        self._readers = [_Camera(engine, *named) for named in zip(addresses, names(addresses), strict=True)]

    def start(self) -> None:
        """Start reading all cameras."""
        for reader in self._readers:
            reader.start()

    def stop(self) -> None:
        """Stop reading all cameras."""
        for reader in self._readers:
            reader.stop()

    def running(self) -> bool:
        """Whether any camera is being read."""
        return any(reader.running() for reader in self._readers)

    def last(self, source: str | None = None) -> list[Result]:
        """Latest result of each camera, or of one given by its name or address."""
        name = source and redacted(source)
        return [one.last for one in self._readers if one.last and name in (None, one.name)]

    def states(self) -> dict[str, dict[str, Any]]:
        """State by camera name: `there`, whether it delivers images, and `images`, their number so far."""
        return {one.name: {"connected": one.is_available(), "images": one.count} for one in self._readers}


def names(addresses: Sequence[str]) -> list[str]:
    """Addresses without credentials; further ones that become equal are numbered."""
    seen: Counter[str] = Counter()
    found = []
    for name in map(redacted, addresses):
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return found


class CameraReader:
    """Reads a camera in a background thread and reconnects if it is unavailable.

    Attributes:
        name: address without credentials, unless another name is given.
        count: number of received images.
    """

    def __init__(
        self,
        address: str,
        callback: Callable[[U8], None],
        name: str = "",
        *,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[threading.Event, float], bool] = threading.Event.wait,
    ) -> None:
        """Create a reader that is started by `start`.

        Args:
            address: as OpenCV accepts it.
            callback: called with each image (H, W, 3) RGB in the reader's thread.
            name: name of the camera; default: address without credentials.
            clock: monotonic clock, seconds.
            wait: waits until the reader is stopped, at most for some seconds; returns whether it is.
        """
        self._address, self._callback, self.name = address, callback, name or redacted(address)
        self._clock, self._wait = clock, wait
        self.count, self._last_image_at = 0, -math.inf
        self._stopped, self._thread = threading.Event(), threading.Thread()

    def start(self) -> None:
        """Start reading."""
        if not self.running():
            self._stopped = threading.Event()
            self._thread = SupervisedThread(partial(self._run, self._stopped), self.name)
            self._thread.start()

    def stop(self) -> None:
        """Stop reading."""
        self._stopped.set()
        if self._thread.ident:
            self._thread.join(CAMERA_TIMEOUT_S)

    def running(self) -> bool:
        """Whether the camera is being read, or reconnected to."""
        return self._thread.is_alive() and not self._stopped.is_set()

    def is_available(self) -> bool:
        """Whether the camera delivers images."""
        return self.running() and self._clock() - self._last_image_at < CAMERA_TIMEOUT_S

    def _run(self, stopped: threading.Event) -> None:
        import cv2

        pause, warned = 0.0, False
        while not self._wait(stopped, pause):
            before = self.count
            video = cv2.VideoCapture(int(self._address) if self._address.isdecimal() else self._address)
            while not stopped.is_set() and (image := _read(video)) is not None:
                pause = 0.0
                self.count += 1
                self._last_image_at = self._clock()
                self._callback(image)
            video.release()
            if self.count == before and not warned and not stopped.is_set():
                log.warning("%s delivers no images: check its address and that it is running; retrying", self.name)
            warned = self.count == before
            pause = min(MAX_RETRY_PAUSE_S, 2 * pause or 0.2)


class _Camera(CameraReader):
    """Camera whose images are submitted to an engine."""

    def __init__(self, engine: Engine, address: str, name: str) -> None:
        super().__init__(address, self._submit, name)
        self._engine = engine
        self.last: Result | None = None

    def stop(self) -> None:
        super().stop()
        self.last = None

    def _submit(self, image: U8) -> None:
        self._engine.submit(Frame(f"{self.count}", self.name, time.time_ns(), image, self._set_last))

    def _set_last(self, result: Result) -> None:
        if result.body is not None and self.running():  # results of queued images may come after `stop`
            self.last = result
