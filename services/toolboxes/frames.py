"""Frames: an image of a camera with its id and stamp, encoded or not, and how it becomes RGB.

An image stays encoded until it is its turn: what is dropped from a queue was never decoded.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.results import Result

FORMATS = ("JPEG", "PNG", "WEBP")
"""Of encoded images; others are refused, as their decoders are seldom looked after."""
LARGEST = 2**25
"""Pixels of an image, 8192 x 4096; one whose header says that it has more is refused before it is decoded."""
REMEDY = f"Send a whole {', '.join(FORMATS)} or an uncompressed image, up to {LARGEST:,} pixels"


@dataclass(frozen=True)
class Raw:
    """An uncompressed image as `sensor_msgs/msg/Image` has it.

    Attributes:
        data: rows of `step` bytes.
        height, width: pixels.
        encoding: name of its pixels' format, one of `ENCODINGS`.
        step: bytes of a row.
        big_endian: of numbers of two bytes.
    """

    data: bytes | memoryview
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False


@dataclass(frozen=True)
class Frame:
    """An image on its way through a toolbox.

    Attributes:
        id: of the image, as its sender calls it.
        source: camera that it is of; frames of one source are kept in order.
        stamp: nanoseconds since the epoch when it was taken, as its sender says; None: not known.
        image: a `Raw` one, the bytes of an encoded one, or (H, W, 3) uint8 RGB.
        answer: is called once with what became of it, from any thread.
        received: monotonic seconds when it came.
    """

    id: str
    source: str
    stamp: int | None
    image: Raw | bytes | U8
    answer: Callable[[Result], None]
    received: float = field(default_factory=time.monotonic)

    def age(self) -> float:
        """Seconds since it came."""
        return time.monotonic() - self.received


def rgb(frame: Frame) -> U8:
    """(H, W, 3) uint8 RGB of a frame's image.

    Raises:
        InputError: it is none, is cut short, too large, or of an encoding that isn't known.
    """
    if isinstance(frame.image, bytes):
        return _decoded(frame.id, frame.image)
    return _converted(frame.id, frame.image) if isinstance(frame.image, Raw) else frame.image


def check_size(where: str, width: int, height: int) -> None:
    """Refuse an image of no pixels, or too many.

    Raises:
        InputError: it is one.
    """
    if width < 1 or height < 1 or width * height > LARGEST:
        raise InputError(where, f"has {width} x {height} pixels", REMEDY)


def _decoded(where: str, data: bytes) -> U8:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as opened:
            check_size(where, *opened.size)
            if opened.mode.startswith("I;16"):  # PIL would cut off what is above 255
                return _three(np.asarray(np.asarray(opened) >> 8, np.uint8))
            return np.asarray(opened.convert("RGB"))
    except InputError:
        raise
    except Exception as error:  # damaged files raise a dozen kinds
        raise InputError(where, f"can't be decoded ({str(error).splitlines()[0][:100]})", REMEDY) from None


def _three(grey: U8) -> U8:
    return np.repeat(grey[..., None], 3, axis=2)


ENCODINGS: dict[str, tuple[str, int, str | None]] = {
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, "BGR2RGB"),
    "rgba8": ("u1", 4, "RGBA2RGB"),
    "bgra8": ("u1", 4, "BGRA2RGB"),
    "mono8": ("u1", 1, "GRAY2RGB"),
    "8UC1": ("u1", 1, "GRAY2RGB"),
    "8UC3": ("u1", 3, "BGR2RGB"),
    "8UC4": ("u1", 4, "BGRA2RGB"),
    "mono16": ("u2", 1, "GRAY2RGB"),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, "BGR2RGB"),
    "yuv422": ("u1", 2, "YUV2RGB_UYVY"),
    "uyvy": ("u1", 2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": ("u1", 2, "YUV2RGB_YUY2"),
    "yuyv": ("u1", 2, "YUV2RGB_YUY2"),
    "bayer_rggb8": ("u1", 1, "BayerRGGB2RGB"),
    "bayer_bggr8": ("u1", 1, "BayerBGGR2RGB"),
    "bayer_gbrg8": ("u1", 1, "BayerGBRG2RGB"),
    "bayer_grbg8": ("u1", 1, "BayerGRBG2RGB"),
}
"""Encodings of ROS 2 (sensor_msgs/image_encodings.hpp): bytes of a number, numbers of a pixel, OpenCV's conversion."""


def _converted(where: str, raw: Raw) -> U8:
    import cv2

    if raw.encoding not in ENCODINGS:
        raise InputError(where, f"is of the encoding {raw.encoding!r:.40}", f"Send one of {', '.join(ENCODINGS)}")
    kind, channels, conversion = ENCODINGS[raw.encoding]
    check_size(where, raw.width, raw.height)
    number = np.dtype(kind).newbyteorder(">" if raw.big_endian else "<")
    row = raw.width * channels * number.itemsize
    if raw.step < row or len(raw.data) < raw.step * (raw.height - 1) + row:
        cause = f"has {len(raw.data)} bytes in rows of {raw.step} for {raw.width} x {raw.height} {raw.encoding}"
        raise InputError(where, cause, REMEDY)
    strides = (raw.step, channels * number.itemsize, number.itemsize)
    pixels: Any = np.ndarray((raw.height, raw.width, channels), number, raw.data, 0, strides)
    levels = np.ascontiguousarray(pixels >> 8 if number.itemsize == 2 else pixels).astype(np.uint8, copy=False)
    if conversion is None:
        return levels
    if conversion.startswith("YUV") and raw.width % 2:
        raise InputError(where, f"is {raw.width} pixels wide, which {raw.encoding} can't be", "Send an even width")
    made: U8 = cv2.cvtColor(levels, getattr(cv2, f"COLOR_{conversion}"))
    return made
