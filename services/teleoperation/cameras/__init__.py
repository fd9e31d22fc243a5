"""Where a vehicle's pictures come from: a file each, found by its name; each camera is read in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation.video import timecode

SILENT = 1.0
"""Seconds without a picture after which a camera counts as gone."""
LONGEST_PAUSE = 5.0
"""Seconds between two tries to open a camera, at most."""


class Picture(NamedTuple):
    """What a camera saw.

    Attributes:
        image: (H, W, 3) RGB, which nobody else draws into.
        captured: nanoseconds of this machine's monotonic clock, when it was exposed, or as soon after as is known.
    """

    image: U8
    captured: int


class Mount(NamedTuple):
    """Where a simulated camera is on its vehicle, and what it sees of the world.

    Attributes:
        x, y, z: metres ahead, to the left and above the vehicle's own place.
        yaw, pitch: degrees to the left, and upwards.
        field: degrees from the left to the right border of the picture.
    """

    x: float = 1.2
    y: float = 0.0
    z: float = 1.5
    yaw: float = 0.0
    pitch: float = -8.0
    field: float = 80.0


class View(NamedTuple):
    """What a camera is asked for; one that is real gives what it can, and may change its size.

    Attributes:
        where: which it is: what that means says each file here.
        width, height: pixels.
        fps: pictures a second.
        marked: have the time drawn into each picture (`marks`).
        mount: of a simulated camera.
        pose: (4, 4) of the simulated vehicle in the world, now: x ahead, y to the left, z up.
    """

    where: str = ""
    width: int = 640
    height: int = 480
    fps: float = 30.0
    marked: bool = False
    mount: Mount = Mount()
    pose: Callable[[], F64] = lambda: np.eye(4)


class Backend(Protocol):
    """What a file here has."""

    def pictures(self, view: View) -> Iterator[Picture]:
        """Pictures in order, each as soon as it is there, until the camera is gone.

        Raises:
            ScanError: it can't be opened, or not any more.
        """


def pictures(source: str, view: View) -> Iterator[Picture]:
    """Pictures of a camera, by the file's name that knows of such; see `Backend.pictures`.

    Raises:
        SettingError: there is no such file.
        UnavailableError: it can't run here.
    """
    backend: Backend = plugins.find(__name__, source, "camera")
    for picture in backend.pictures(view):
        if view.marked:
            timecode.mark(picture.image, picture.captured)
        yield picture


class Camera:
    """Reads a camera; of its pictures only the newest waits. One that is gone is looked for again.

    Attributes:
        name: as drivers know it.
        fault: why it is gone, in words; empty: it isn't.
        count: pictures that came.
    """

    def __init__(self, name: str, open_: Callable[[], Iterator[Picture]]) -> None:
        """Of pictures, as `pictures` gives them; begins at once."""
        self.name, self.fault, self.count = name, "", 0
        self._open = open_
        self._newest: Picture | None = None
        self._came = time.monotonic()
        self._there = threading.Condition()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._thread.start()

    def read(self, patience: float) -> Picture | None:
        """The newest picture, once; None: none came within so many seconds."""
        with self._there:
            self._there.wait_for(lambda: self._newest is not None or self._closed.is_set(), patience)
            newest, self._newest = self._newest, None
            return newest

    @property
    def gone(self) -> bool:
        """Whether pictures have stopped coming."""
        return time.monotonic() > self._came + SILENT

    def close(self) -> None:
        """Read no more."""
        self._closed.set()
        with self._there:
            self._there.notify_all()
        self._thread.join(LONGEST_PAUSE)

    def _run(self) -> None:
        pause = 0.1
        while not self._closed.is_set():
            count = self.count
            try:
                self._follow(self._open())
                self.fault = "it gives no more pictures"
            except Exception as error:  # of any library: it is told, and looked for again
                self.fault = redacted(str(error))
            pause = 0.1 if self.count > count else min(LONGEST_PAUSE, 2 * pause)
            self._closed.wait(pause)

    def _follow(self, pictures: Iterator[Picture]) -> None:
        for picture in pictures:
            if self._closed.is_set():
                return
            self.fault = ""
            with self._there:
                self._newest, self._came = picture, time.monotonic()
                self.count += 1
                self._there.notify_all()


def ticks(fps: float) -> Iterator[int]:
    """Nanoseconds of the monotonic clock, so many times a second; those that come too late are left out."""
    step = 1e9 / fps
    due = float(time.monotonic_ns())
    while True:
        now = time.monotonic_ns()
        if now < due:
            time.sleep((due - now) / 1e9)
        yield time.monotonic_ns()
        due = max(due + step, time.monotonic_ns() - step)
