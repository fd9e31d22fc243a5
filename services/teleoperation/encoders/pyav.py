"""libvpx by PyAV: its wheels bring it along."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.encoders import Settings

NEEDS, EXTRA = ("av",), "teleop"
RANK = 3
CLOCK = 90_000
LARGEST_KEY = 300
"""Percent of a frame's share of the rate that a key frame may take: without a bound the first takes a second's."""
SPEED = -8
"""Of libvpx; a positive one changes with the machine's load, and takes more of an idle one."""
LEAST_BUFFER = 10
"""Percent of the rate's buffer below which a frame is left out, where even coarse ones are too large."""
OPTIONS = {
    "deadline": "realtime",
    "cpu-used": str(SPEED),
    "lag-in-frames": "0",
    "max-intra-rate": str(LARGEST_KEY),
    "drop-threshold": str(LEAST_BUFFER),
}


def lacking() -> Lacking | None:
    """Nothing beyond the package."""
    return None


def encoder(settings: Settings) -> Encoder:
    """In the thread that calls it; meanwhile others run."""
    rate, half = str(settings.bitrate), str(settings.bitrate // 2)
    return Encoder("libvpx", settings, OPTIONS | {"minrate": rate, "maxrate": rate, "bufsize": half})


class Encoder:
    """One of FFmpeg's."""

    def __init__(self, codec: str, settings: Settings, options: dict[str, str]) -> None:
        import av
        from av.video.frame import PictureType

        self._av, self._key = av, PictureType.I
        create: Any = av.CodecContext.create
        self._codec = create(codec, "w")
        self._codec.width, self._codec.height, self._codec.pix_fmt = settings.width, settings.height, "yuv420p"
        self._codec.framerate = Fraction(settings.fps).limit_denominator(1001)
        self._codec.time_base = Fraction(1, CLOCK)
        self._codec.bit_rate, self._codec.gop_size = settings.bitrate, 9999
        self._codec.thread_count = 1
        self._codec.options = options
        self._first: int | None = None
        self._last = -1

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """See `video.Encoder`."""
        if self._first is None:
            self._first = captured
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self._last = frame.pts = max(self._last + 1, (captured - self._first) * 9 // 100_000)
        if key:
            frame.pict_type = self._key
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))

    def close(self) -> None:
        """FFmpeg frees it with the object."""
