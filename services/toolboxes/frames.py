"""Frames: images with id and time stamp, encoded or raw, and their conversion to RGB.

An image is decoded just before inference, so that frames dropped from the queue cost no decoding.
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
"""Accepted formats of encoded images; decoders of others are poorly maintained and thus a security risk."""
MAX_PIXELS = 2**25
"""Largest image, such as 8192 x 4096; the header is checked before decoding (decompression bombs)."""
MAX_ASPECT = 100
"""Largest ratio of the sides of an image; scaled to a network's input, longer ones vanish."""
REMEDY = (
    f"Send a complete {', '.join(FORMATS)} or an uncompressed image of at most {MAX_PIXELS:,} pixels, "
    f"and sides of at most {MAX_ASPECT} : 1"
)


@dataclass(frozen=True)
class Raw:
    """An uncompressed image as in `sensor_msgs/msg/Image`.

    Attributes:
        data: rows of `step` bytes.
        height, width: size in pixels.
        encoding: pixel format, one of `ENCODINGS`.
        step: bytes per row.
        big_endian: byte order of 16-bit values.
    """

    data: bytes | memoryview
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False

    @classmethod
    def of(cls, message: Any) -> Raw:
        """The image of a `sensor_msgs/msg/Image`, whose data it shares."""
        data = memoryview(message.data)
        return cls(
            data=data.cast("B") if data.nbytes else b"",
            height=message.height,
            width=message.width,
            encoding=message.encoding,
            step=message.step,
            big_endian=bool(message.is_bigendian),
        )


@dataclass(frozen=True)
class Frame:
    """An image to be processed by a toolbox.

    Attributes:
        id: id given by the sender.
        source: camera or stream of the image; frames of one source are processed in order.
        stamp: time of capture according to the sender, nanoseconds since the epoch; None: unknown.
        image: a `Raw` image, the bytes of an encoded one, or (H, W, 3) uint8 RGB.
        answer: called exactly once with the result, from any thread.
        queue: name of the queue in which it waits; "": that of its source.
        request: request that it is a part of; the requests in a queue are served in turn.
        deadline: seconds from its arrival to its result; None: the toolbox's.
        is_wanted: whether somebody still waits for its result; frames that nobody does are dropped.
        received: monotonic time of arrival, seconds.
    """

    id: str
    source: str
    stamp: int | None
    image: Raw | bytes | U8
    answer: Callable[[Result], None]
    queue: str = ""
    request: object = None
    deadline: float | None = None
    is_wanted: Callable[[], bool] = lambda: True
    received: float = field(default_factory=time.monotonic)


def rgb(frame: Frame) -> U8:
    """Decode the image of a frame to (H, W, 3) uint8 RGB.

    Raises:
        InputError: the image is malformed, truncated, too large, or has an unknown encoding.
    """
    if isinstance(frame.image, bytes):
        return _decoded(frame.id, frame.image)
    return _converted(frame.id, frame.image) if isinstance(frame.image, Raw) else frame.image


def check_size(where: str, width: int, height: int) -> None:
    """Check that an image isn't empty, too large or too long.

    Raises:
        InputError: it is.
    """
    too_long = max(width, height) > MAX_ASPECT * min(width, height)
    if min(width, height) < 1 or width * height > MAX_PIXELS or too_long:
        raise InputError(where, f"has {width} x {height} pixels", REMEDY)


def _decoded(where: str, data: bytes) -> U8:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as opened:
            check_size(where, *opened.size)
            if opened.mode.startswith("I;16"):  # PIL would clip values above 255
                return _grey_to_rgb(np.asarray(np.asarray(opened) >> 8, np.uint8))
            return np.asarray(opened.convert("RGB"))
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(where, "can't be decoded (the format is unknown)", REMEDY) from None
    except Exception as error:  # damaged files raise errors of many types
        cause = (str(error) or type(error).__name__).splitlines()[0][:100]
        raise InputError(where, f"can't be decoded ({cause})", REMEDY) from None


def _grey_to_rgb(grey: U8) -> U8:
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
"""Encodings of ROS 2 (sensor_msgs/image_encodings.hpp): value type, values per pixel, OpenCV conversion to RGB."""


def _converted(where: str, raw: Raw) -> U8:
    import cv2

    if raw.encoding not in ENCODINGS:
        raise InputError(where, f"has unknown encoding {raw.encoding!r:.40}", f"Use one of {', '.join(ENCODINGS)}")
    kind, channels, conversion = ENCODINGS[raw.encoding]
    check_size(where, raw.width, raw.height)
    dtype = np.dtype(kind).newbyteorder(">" if raw.big_endian else "<")
    row_bytes = raw.width * channels * dtype.itemsize
    if raw.step < row_bytes or len(raw.data) < raw.step * (raw.height - 1) + row_bytes:
        cause = f"has {len(raw.data)} bytes in rows of {raw.step} for {raw.width} x {raw.height} {raw.encoding}"
        raise InputError(where, cause, REMEDY)
    strides = (raw.step, channels * dtype.itemsize, dtype.itemsize)
    pixels: Any = np.ndarray((raw.height, raw.width, channels), dtype, raw.data, 0, strides)
    values = np.ascontiguousarray(pixels >> 8 if dtype.itemsize == 2 else pixels).astype(np.uint8, copy=False)
    if conversion is None:
        return values
    if conversion.startswith("YUV") and raw.width % 2:
        raise InputError(where, f"has odd width {raw.width}, but {raw.encoding} needs an even one", "Crop the image")
    result: U8 = cv2.cvtColor(values, getattr(cv2, f"COLOR_{conversion}"))
    return result
