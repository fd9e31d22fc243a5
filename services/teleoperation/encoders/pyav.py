"""libvpx by PyAV, whose wheels include it."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.encoders import EncoderSettings

NEEDS, EXTRA = ("av",), "teleop"
RANK = 1
TIME_BASE_HZ = 90_000
KEY_FRAME_MAX_PERCENT = 300
"""Maximum size of a key frame, percent of the mean frame size; unlimited, the first one takes a second's bits."""
CPU_USED = -8
"""libvpx speed preset; positive values adapt to the machine's load, and cost more on an idle machine."""
DROP_THRESHOLD_PERCENT = 10
"""Fill level of the rate control buffer, percent, below which a frame is dropped."""
OPTIONS = {
    "deadline": "realtime",
    "cpu-used": str(CPU_USED),
    "lag-in-frames": "0",
    "max-intra-rate": str(KEY_FRAME_MAX_PERCENT),
    "drop-threshold": str(DROP_THRESHOLD_PERCENT),
}


def unavailable() -> Unavailable | None:
    """None: PyAV is all it needs."""
    return None


def encoder(settings: EncoderSettings) -> Encoder:
    """Create an encoder that runs in the calling thread, with the GIL released."""
    return Encoder(settings)


class Encoder:
    """libvpx as an FFmpeg encoder, at a constant bit rate."""

    def __init__(self, settings: EncoderSettings) -> None:
        import av
        from av.video.frame import PictureType

        self._av, self._key = av, PictureType.I
        create: Any = av.CodecContext.create
        self._codec = create("libvpx", "w")
        self._codec.width, self._codec.height, self._codec.pix_fmt = settings.width, settings.height, "yuv420p"
        self._codec.framerate = Fraction(settings.fps).limit_denominator(1001)
        self._codec.time_base = Fraction(1, TIME_BASE_HZ)
        self._codec.bit_rate, self._codec.gop_size = settings.bitrate, 9999
        self._codec.thread_count = 1
        rate, half = str(settings.bitrate), str(settings.bitrate // 2)
        self._codec.options = OPTIONS | {"minrate": rate, "maxrate": rate, "bufsize": half}
        self._first: int | None = None
        self._last = -1

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """See `encoders.Encoder`."""
        if self._first is None:
            self._first = captured
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self._last = frame.pts = max(self._last + 1, (captured - self._first) * 9 // 100_000)
        if key:
            frame.pict_type = self._key
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))

    def close(self) -> None:
        """Nothing to do: FFmpeg frees the encoder with the object."""
