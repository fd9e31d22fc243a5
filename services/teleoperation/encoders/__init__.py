"""VP8 encoders: a file each, found by its name (`pipeline.core.plugins`); and how a picture is decoded."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.pipeline.core.types import U8


class Settings(NamedTuple):
    """Of an encoder; an encoder keeps them all its life.

    Attributes:
        width, height: pixels, even.
        fps: pictures a second.
        bitrate: bits a second.
    """

    width: int
    height: int
    fps: float
    bitrate: int


class Encoder(Protocol):
    """Encodes a camera's pictures, each at once; its first is a key frame, later ones only where that is asked for."""

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """A frame of VP8; empty: it was left out, for the rate.

        Args:
            planes: (H * 3 / 2, W), the picture as I420.
            captured: nanoseconds of any clock; the rate is held by it.
            key: make it a key frame.
        """

    def close(self) -> None:
        """It isn't used any more."""


class Backend(Protocol):
    """What a file here has.

    Attributes:
        RANK: the lower, the less it costs the processor.
    """

    RANK: int

    def lacking(self) -> Lacking | None:
        """What isn't there; None: it can run here."""

    def encoder(self, settings: Settings) -> Encoder:
        """A new one."""


def find(name: str | None = None) -> Backend:
    """A backend that can run here: of that name, or the best.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: it can't run here, or none can.
    """
    found: Backend = plugins.best(__name__, name, "encoder", "video")
    return found


def planes(image: U8) -> U8:
    """An (H, W, 3) RGB picture as I420 (H * 3 / 2, W), BT.601; an odd row or column at the end is cut off."""
    import cv2

    height, width = (side // 2 * 2 for side in image.shape[:2])
    i420: Any = cv2.cvtColor(image[:height, :width], cv2.COLOR_RGB2YUV_I420)
    return i420


class Decoder:
    """Decodes a camera's frames, each at once."""

    def __init__(self) -> None:
        """Raises UnavailableError where PyAV isn't there."""
        need("VP8", "av", extra="teleop")
        import av

        self._av = av
        self._codec = av.CodecContext.create("vp8", "r")
        self._codec.thread_type = "NONE"  # threads would hold frames back

    def decode(self, data: bytes) -> U8 | None:
        """(H, W, 3) RGB of a frame; None: it can't be decoded."""
        import cv2

        try:
            frames = self._codec.decode(self._av.Packet(data))
        except self._av.FFmpegError:
            return None
        rgb: Any = cv2.cvtColor(frames[-1].to_ndarray(), cv2.COLOR_YUV2RGB_I420) if frames else None
        return rgb
