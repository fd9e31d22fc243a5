"""Video pipeline of a camera: scale, encode, encrypt and send its frames, in a thread for each camera.

A frame is encoded at once or not at all: during encoding, `cameras.Camera` keeps only the newest frame.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from scan2sim.pipeline.core.types import U8
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.cameras import Camera, CameraFrame
from scan2sim.services.teleoperation.control.messages import VideoStream
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule, PacketEncryptor

KEY_FRAME_INTERVAL_MIN_NS = 150_000_000
"""Minimum interval between requested key frames; an earlier request is satisfied by the last key frame."""
PAUSE_INTERVAL_MIN_S = 0.3
"""Minimum time from the end of a pause to the next: until then reports may be about the time before."""
ENCODER_RETRY_DELAY_S = 0.5
"""Delay after an encoder failed until another one is created."""


class CameraEncoder:
    """Encodes and encrypts a camera's frames; has no thread.

    Attributes:
        size: width and height of the last encoded frame.
        counts: `pictures` received, `skipped` for the rate, `frames`, `keys`, `packets`, `bytes`, `encoders` created;
            packets that were retransmitted (`again`).
    """

    def __init__(self, camera: int, keys: KeySchedule, backend: encoders.Backend) -> None:
        """`camera`: number of the camera; `backend`: encoder module."""
        self.size = (0, 0)
        self.counts: Counter[str] = Counter()
        self._backend, self._keys = backend, keys
        self._encryptor = PacketEncryptor(keys, camera)
        self._encoder: encoders.Encoder | None = None
        self._settings: encoders.EncoderSettings | None = None
        self._key_frame_requested = False
        self._last_key_frame = 0
        self._due = 0.0

    def request_key_frame(self) -> None:
        """Make the next frame a key frame, unless the last one is recent; thread-safe."""
        self._key_frame_requested = True

    def retransmit(self, source: int, sequences: Sequence[int]) -> list[bytes]:
        """Packets to retransmit that are still buffered; may be called in one other thread."""
        packets = self._encryptor.retransmit(source, sequences)
        self.counts["again"] += len(packets)
        return packets

    def encode(self, frame: CameraFrame, plan: EncodingPlan, now: float) -> list[bytes]:
        """Packets of a frame; none: the frame is dropped for the rate. `now`: clock of `KeySchedule`."""
        self.counts["pictures"] += 1
        if self._skips(frame, plan):
            self.counts["skipped"] += 1
            return []
        planes = encoders.to_i420(downscale(frame.image, plan.scale))
        encoder, created = self._encoder_for(planes, plan)
        key = (
            self._encryptor.update_key(now)
            or created
            or (self._key_frame_requested and frame.captured >= self._last_key_frame + KEY_FRAME_INTERVAL_MIN_NS)
        )
        data = encoder.encode(planes, frame.captured, key)
        if not data:
            self._key_frame_requested = self._key_frame_requested or key
            self.counts["skipped"] += 1
            return []
        if key:
            self._key_frame_requested, self._last_key_frame = False, frame.captured
        packets = self._encryptor.encrypt(data, frame.captured)
        self.counts.update(frames=1, keys=key, packets=len(packets), bytes=sum(map(len, packets)))
        return packets

    def close(self) -> None:
        """Release the encoder."""
        if self._encoder:
            self._encoder.close()
            self._encoder = None

    def _skips(self, frame: CameraFrame, plan: EncodingPlan) -> bool:
        interval = 1e9 / plan.fps
        if frame.captured < self._due - interval / 4:
            return True
        self._due = max(self._due, frame.captured - interval / 2) + interval
        return False

    def _encoder_for(self, planes: U8, plan: EncodingPlan) -> tuple[encoders.Encoder, bool]:
        """Encoder for this frame size and plan, and whether it is a new one."""
        width, height = planes.shape[1], planes.shape[0] * 2 // 3
        settings = encoders.EncoderSettings(width, height, plan.fps, plan.bitrate)
        if self._encoder and settings == self._settings:
            return self._encoder, False
        self.close()
        self._encoder, self._settings, self.size = self._backend.encoder(settings), settings, (width, height)
        self.counts["encoders"] += 1
        return self._encoder, True


def downscale(image: U8, scale: float) -> U8:
    """Scale an image down."""
    import cv2

    if scale == 1.0:
        return image
    smaller: Any = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return smaller


class CameraStreamer:
    """Sends a camera's video, in its own thread.

    Attributes:
        plan: encoding parameters; may be set at any time.
        fault: error with the last frame; empty: none.
    """

    def __init__(
        self,
        number: int,
        camera: Camera,
        encoder: CameraEncoder,
        send: Callable[[Sequence[bytes]], None],
        plan: EncodingPlan,
    ) -> None:
        """Start sending; `send` is called with the packets of each frame, in this thread."""
        self.number, self.camera, self.encoder, self.plan, self.fault = number, camera, encoder, plan, ""
        self._send, self._paused_until = send, -PAUSE_INTERVAL_MIN_S
        self._closed = threading.Event()
        self._thread = SupervisedThread(self._run, f"video {camera.name}")
        self._thread.start()

    @property
    def stream(self) -> VideoStream:
        """Description of the stream for the station."""
        offline = self.camera.offline or self.fault
        return VideoStream(self.number, self.camera.name, *self.encoder.size, 0.0 if offline else self.plan.fps)

    def pause(self, seconds: float) -> None:
        """Send no frames for some time, so that a queue drains; ignored shortly after the last pause."""
        if (now := time.monotonic()) > self._paused_until + PAUSE_INTERVAL_MIN_S:
            self._paused_until = now + seconds

    def close(self) -> None:
        """Stop sending; the camera stays open."""
        self._closed.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        while not self._closed.is_set():
            frame = self.camera.read(0.5)
            if frame is None or time.monotonic() < self._paused_until:
                continue
            try:
                packets = self.encoder.encode(frame, self.plan, time.monotonic())
            except Exception as error:  # of any library: other cameras continue, and this one with a new encoder
                self.fault = str(error)
                self.encoder.close()
                self._closed.wait(ENCODER_RETRY_DELAY_S)
                continue
            self.fault = ""
            if packets:
                self._send(packets)
        self.encoder.close()
