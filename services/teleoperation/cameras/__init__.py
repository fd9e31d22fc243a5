"""Camera sources: one module for each kind of source, found by name; each camera is read in its own thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.core.types import Camera as PinholeCamera
from scan2sim.services.credentials import redacted
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation import timecode

CAMERA_TIMEOUT_S = 1.0
"""Seconds without a frame after which a camera counts as offline."""
REOPEN_DELAY_MAX_S = 5.0
"""Maximum delay between two attempts to open a camera, seconds."""


class CameraFrame(NamedTuple):
    """A frame of a camera.

    Attributes:
        image: (H, W, 3) RGB; the receiver owns it and may draw into it.
        captured: exposure time, nanoseconds of this machine's monotonic clock; time of arrival where it is unknown.
    """

    image: U8
    captured: int


class Mount(NamedTuple):
    """Mounting pose and field of view of a simulated camera on its vehicle.

    Attributes:
        x, y, z: metres ahead, to the left and above the vehicle's origin.
        yaw, pitch: degrees, positive to the left and upwards.
        field: horizontal field of view, degrees.
    """

    x: float = 1.2
    y: float = 0.0
    z: float = 1.5
    yaw: float = 0.0
    pitch: float = -8.0
    field: float = 80.0

    def pose(self) -> F64:
        """Transform (4, 4) from the camera (x right, y down, z ahead) to the vehicle (x ahead, y left, z up)."""
        from scipy.spatial.transform import Rotation

        pose = np.eye(4)
        rotation = Rotation.from_euler("ZY", [self.yaw, -self.pitch], degrees=True).as_matrix()
        pose[:3, :3] = rotation @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        pose[:3, 3] = self[:3]
        return pose


class SplatWorld(Protocol):
    """A world that is rendered from splats (`texturing.world_camera.WorldCamera`)."""

    def colours(self, T_world_cam: F64, camera: PinholeCamera) -> U8:
        """Image (H, W, 3), RGB, from a camera pose (4, 4)."""


OpenWorld = Callable[[Path], SplatWorld]
"""Opens the world in a folder."""


class View(NamedTuple):
    """Requested view of a camera; a real camera may deliver another frame size or rate.

    Attributes:
        location: device, file, folder or address; each source defines its meaning.
        width, height: pixels.
        fps: frames/s.
        draw_timecode: draw the capture time into each frame (`timecode`).
        mount: of a simulated camera.
        pose: returns the simulated vehicle's current pose (4, 4) in the world: x ahead, y left, z up.
        open_world: opens worlds with splats; None: can't.
    """

    location: str = ""
    width: int = 640
    height: int = 480
    fps: float = 30.0
    draw_timecode: bool = False
    mount: Mount = Mount()
    pose: Callable[[], F64] = lambda: np.eye(4)
    open_world: OpenWorld | None = None


class Backend(Protocol):
    """Interface of a camera source module."""

    def frames(self, view: View) -> Iterator[CameraFrame]:
        """Yield frames in order, each as soon as it is available, until the camera is lost.

        Raises:
            ScanError: the camera cannot be opened, or was lost.
        """


def frames(source: str, view: View) -> Iterator[CameraFrame]:
    """Yield frames of a camera from the source module of that name; see `Backend.frames`.

    Raises:
        SettingError: there is no such source.
        UnavailableError: it can't run here.
    """
    backend: Backend = plugins.find(__name__, source, "camera")
    for frame in backend.frames(view):
        if view.draw_timecode:
            timecode.draw(frame.image, frame.captured)
        yield frame


class Camera:
    """Reads a camera in a thread and keeps only the newest frame; reopens the camera when it is lost.

    Attributes:
        name: shown to drivers.
        fault: why the camera is offline; empty: no fault.
        count: frames received so far.
    """

    def __init__(
        self,
        name: str,
        open_: Callable[[], Iterator[CameraFrame]],
        *,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[threading.Event, float], bool] = threading.Event.wait,
    ) -> None:
        """Start reading at once.

        Args:
            name: shown to drivers.
            open_: opens the camera and returns its frames (`frames`).
            clock: monotonic clock, seconds.
            wait: waits until the camera is closed, at most for some seconds; returns whether it is.
        """
        self.name, self.fault, self.count = name, "", 0
        self._open, self._clock, self._wait = open_, clock, wait
        self._newest: CameraFrame | None = None
        self._last_frame = clock()
        self._frame_available = threading.Condition()
        self._closed = threading.Event()
        self._thread = SupervisedThread(self._run, f"camera {name}")
        self._thread.start()

    def read(self, timeout_s: float) -> CameraFrame | None:
        """Return the newest frame, each frame once; None: no frame arrived within the timeout."""
        with self._frame_available:
            self._frame_available.wait_for(lambda: self._newest is not None or self._closed.is_set(), timeout_s)
            newest, self._newest = self._newest, None
            return newest

    @property
    def offline(self) -> bool:
        """Whether no frame has arrived within `CAMERA_TIMEOUT_S`."""
        return self._clock() > self._last_frame + CAMERA_TIMEOUT_S

    def close(self) -> None:
        """Stop reading."""
        self._closed.set()
        with self._frame_available:
            self._frame_available.notify_all()
        self._thread.join(REOPEN_DELAY_MAX_S)

    def _run(self) -> None:
        pause = 0.1
        while not self._closed.is_set():
            count = self.count
            try:
                self._read_frames(self._open())
                self.fault = "the camera delivers no more frames"
            except Exception as error:  # of any library: reported as the fault, then the camera is reopened
                self.fault = redacted(str(error))
            pause = 0.1 if self.count > count else min(REOPEN_DELAY_MAX_S, 2 * pause)
            self._wait(self._closed, pause)

    def _read_frames(self, frames: Iterator[CameraFrame]) -> None:
        for frame in frames:
            if self._closed.is_set():
                return
            self.fault = ""
            with self._frame_available:
                self._newest, self._last_frame = frame, self._clock()
                self.count += 1
                self._frame_available.notify_all()


def frame_times(
    fps: float,
    *,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[int]:
    """Yield capture times, nanoseconds of a monotonic clock, at a frame rate; missed frames are skipped."""
    step = 1e9 / fps
    due = float(clock())
    while True:
        now = clock()
        if now < due:
            sleep((due - now) / 1e9)
        yield clock()
        due = max(due + step, clock() - step)
