"""VP8 encoders: one module for each, found by name (`pipeline.core.plugins`); and the VP8 decoder."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import U8


class EncoderSettings(NamedTuple):
    """Settings of an encoder, fixed for its lifetime.

    Attributes:
        width, height: pixels, even.
        fps: frames/s.
        bitrate: bit/s.
    """

    width: int
    height: int
    fps: float
    bitrate: int


class Encoder(Protocol):
    """Encodes a camera's frames without delay; the first is a key frame, later ones only on request."""

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """Encode a frame as VP8; empty: the frame was dropped to keep the bit rate.

        Args:
            planes: (H * 3 / 2, W), the image as I420.
            captured: capture time, nanoseconds of any clock; rate control uses it.
            key: force a key frame.
        """

    def close(self) -> None:
        """Release the encoder."""


class Backend(Protocol):
    """Interface of an encoder module.

    Attributes:
        RANK: processor cost; the available encoder of the lowest rank is chosen.
    """

    RANK: int

    def unavailable(self) -> Unavailable | None:
        """Why the encoder can't run here; None: it can."""

    def encoder(self, settings: EncoderSettings) -> Encoder:
        """Create an encoder."""


def find(name: str | None = None) -> Backend:
    """The encoder module of that name, or the available one of the lowest rank.

    Raises:
        SettingError: there is no encoder of that name.
        UnavailableError: it can't run here, or none can.
    """
    found: Backend = plugins.best(__name__, name, "encoder", "video")
    return found


def to_i420(image: U8) -> U8:
    """Convert an (H, W, 3) RGB image to I420 (H * 3 / 2, W), BT.601; an odd last row or column is cropped."""
    import cv2

    height, width = (side // 2 * 2 for side in image.shape[:2])
    i420: Any = cv2.cvtColor(image[:height, :width], cv2.COLOR_RGB2YUV_I420)
    return i420


class Decoder:
    """Decodes a camera's VP8 frames without delay."""

    def __init__(self) -> None:
        """Raises UnavailableError if PyAV is not installed."""
        require("VP8", "av", extra="teleop")
        import av

        self._av = av
        self._codec = av.CodecContext.create("vp8", "r")
        self._codec.thread_type = "NONE"  # decoding threads would delay frames

    def decode(self, data: bytes) -> U8 | None:
        """Decode a frame to (H, W, 3) RGB; None: it cannot be decoded."""
        import cv2

        try:
            frames = self._codec.decode(self._av.Packet(data))
        except self._av.FFmpegError:
            return None
        rgb: Any = cv2.cvtColor(frames[-1].to_ndarray(), cv2.COLOR_YUV2RGB_I420) if frames else None
        return rgb
