"""A camera's pictures to encrypted packets: sized, encoded and sent in a thread of the camera's own.

A picture is encoded at once or not at all: while one is encoded, newer ones replace each other in `cameras.Camera`.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.cameras import Camera, Picture
from scan2sim.services.teleoperation.control.messages import Stream
from scan2sim.services.teleoperation.video.rate_control import Plan
from scan2sim.services.teleoperation.video.srtp_session import Keys, Sealer

KEY_PAUSE = 150_000_000
"""Nanoseconds between two key frames that are wanted: what was wanted meanwhile, the last may have brought."""
PAUSE = 0.5
"""Seconds after an encoder failed, until another is tried."""


class Coder:
    """A camera's pictures to packets; knows no threads.

    Attributes:
        size: width and height of what was sent last.
        counts: `pictures` that came, `skipped` for the rate, `frames`, `keys`, `packets`, `bytes`, `encoders` made;
            packets that were sent `again`.
    """

    def __init__(self, camera: int, keys: Keys, backend: encoders.Backend) -> None:
        """Of the camera's number, and the backend that encodes it."""
        self.size = (0, 0)
        self.counts: Counter[str] = Counter()
        self._backend, self._keys = backend, keys
        self._sealer = Sealer(keys, camera)
        self._encoder: encoders.Encoder | None = None
        self._settings: encoders.Settings | None = None
        self._wanted = False
        self._last_key = 0
        self._due = 0.0

    def want_key(self) -> None:
        """The next frame be a key frame, if the last one is some time ago. May be called in any thread."""
        self._wanted = True

    def again(self, source: int, sequences: Sequence[int]) -> list[bytes]:
        """Packets that didn't come, as far as they are still kept. May be called in one other thread."""
        packets = self._sealer.again(source, sequences)
        self.counts["again"] += len(packets)
        return packets

    def code(self, picture: Picture, plan: Plan, now: float) -> list[bytes]:
        """Packets of a picture; none: the plan wants fewer pictures. `now`: the clock of `Keys`."""
        self.counts["pictures"] += 1
        if self._skips(picture, plan):
            self.counts["skipped"] += 1
            return []
        planes = encoders.planes(scaled(picture.image, plan.scale))
        encoder, made = self._encoder_for(planes, plan)
        key = self._sealer.renew(now) or made or (self._wanted and picture.captured >= self._last_key + KEY_PAUSE)
        data = encoder.encode(planes, picture.captured, key)
        if not data:
            self._wanted = self._wanted or key
            self.counts["skipped"] += 1
            return []
        if key:
            self._wanted, self._last_key = False, picture.captured
        packets = self._sealer.seal(data, picture.captured)
        self.counts.update(frames=1, keys=key, packets=len(packets), bytes=sum(map(len, packets)))
        return packets

    def close(self) -> None:
        """No more pictures come."""
        if self._encoder:
            self._encoder.close()
            self._encoder = None

    def _skips(self, picture: Picture, plan: Plan) -> bool:
        step = 1e9 / plan.fps
        if picture.captured < self._due - step / 4:
            return True
        self._due = max(self._due, picture.captured - step / 2) + step
        return False

    def _encoder_for(self, planes: U8, plan: Plan) -> tuple[encoders.Encoder, bool]:
        """An encoder for pictures of that size and the plan; whether it is a new one."""
        width, height = planes.shape[1], planes.shape[0] * 2 // 3
        asked = encoders.Settings(width, height, plan.fps, plan.bitrate)
        if self._encoder and asked == self._settings:
            return self._encoder, False
        self.close()
        self._encoder, self._settings, self.size = self._backend.encoder(asked), asked, (width, height)
        self.counts["encoders"] += 1
        return self._encoder, True


def scaled(image: U8, scale: float) -> U8:
    """A picture made smaller."""
    import cv2

    if scale == 1.0:
        return image
    smaller: Any = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return smaller


class Streamer:
    """Sends a camera's pictures, in a thread of its own.

    Attributes:
        plan: how they are sent; may be set at any time.
        fault: what went wrong with the last picture, in words; empty: nothing.
    """

    def __init__(
        self, number: int, camera: Camera, coder: Coder, send: Callable[[Sequence[bytes]], None], plan: Plan
    ) -> None:
        """`send` is given the packets of a frame at a time, in that thread; begins at once."""
        self.number, self.camera, self.coder, self.plan, self.fault = number, camera, coder, plan, ""
        self._send = send
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"video {camera.name}", daemon=True)
        self._thread.start()

    @property
    def stream(self) -> Stream:
        """What the station is told of it."""
        gone = self.camera.gone or self.fault
        return Stream(self.number, self.camera.name, *self.coder.size, 0.0 if gone else self.plan.fps)

    def close(self) -> None:
        """Send no more; the camera stays open."""
        self._closed.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        while not self._closed.is_set():
            picture = self.camera.read(0.5)
            if picture is None:
                continue
            try:
                packets = self.coder.code(picture, self.plan, time.monotonic())
            except Exception as error:  # of any library: the other cameras go on, and this one with another encoder
                self.fault = str(error)
                self.coder.close()
                self._closed.wait(PAUSE)
                continue
            self.fault = ""
            if packets:
                self._send(packets)
        self.coder.close()
