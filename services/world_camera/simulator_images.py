"""A simulator's own colour and depth images: pairs of the same time, and their content."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.frames import Frame, Raw
from scan2sim.services.world_camera.pose_source import stamp_ns

MAX_WAITING = 8
"""Images of each kind that wait for the other."""
SAME_TIME_NS = 2_000_000
"""Largest difference of the time stamps of a pair."""
DEPTH_ENCODINGS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 0.001), "mono16": ("u2", 0.001)}
"""Encodings of depth images (REP 118): value type, metres per unit."""


class Pair(NamedTuple):
    """A colour and a depth image (`sensor_msgs/Image`) of the same time, nanoseconds."""

    time: int
    colour: Any
    depth: Any


class ImagePairs:
    """Colour and depth images of a simulator, paired by their time stamps."""

    def __init__(self) -> None:
        self._colour: list[Any] = []
        self._depth: list[Any] = []

    def add_colour(self, message: Any) -> Pair | None:
        """Add a colour image; returns it with its depth image, if that has arrived."""
        depth = _matching(self._depth, self._colour, message)
        return None if depth is None else Pair(stamp_ns(message.header), message, depth)

    def add_depth(self, message: Any) -> Pair | None:
        """Add a depth image; returns it with its colour image, if that has arrived."""
        colour = _matching(self._colour, self._depth, message)
        return None if colour is None else Pair(stamp_ns(colour.header), colour, message)


def _matching(others: list[Any], own: list[Any], message: Any) -> Any | None:
    """The other image of the same time, which leaves its list; if there is none, the message waits in its own list."""
    time = stamp_ns(message.header)
    for k, other in enumerate(others):
        if abs(stamp_ns(other.header) - time) <= SAME_TIME_NS:
            del others[: k + 1]  # older ones have lost theirs
            return other
    own.append(message)
    del own[:-MAX_WAITING]
    return None


def colour_of(message: Any) -> U8:
    """(H, W, 3) RGB of an image.

    Raises:
        InputError: it is malformed, too large, or has an unknown encoding.
    """
    return frames.rgb(Frame("colour image", "", None, Raw.of(message), lambda _: None))


def depth_of(message: Any) -> F32:
    """(H, W) metres along the optical axis of a depth image, as it has them (NaN, inf or 0 where there is nothing).

    Raises:
        InputError: it is malformed, too large, or has an unknown encoding.
    """
    raw = Raw.of(message)
    frames.check_size("depth image", raw.width, raw.height)
    if raw.encoding not in DEPTH_ENCODINGS:
        remedy = f"Use one of {', '.join(DEPTH_ENCODINGS)}"
        raise InputError("depth image", f"has unknown encoding {raw.encoding!r:.40}", remedy)
    kind, unit = DEPTH_ENCODINGS[raw.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if raw.big_endian else "<")
    row = raw.width * dtype.itemsize
    if raw.step < row or len(raw.data) < raw.step * (raw.height - 1) + row:
        cause = f"has {len(raw.data)} bytes in rows of {raw.step} for {raw.width} x {raw.height} {raw.encoding}"
        raise InputError("depth image", cause, "Send a complete image")
    values = np.ndarray((raw.height, raw.width), dtype, raw.data, 0, (raw.step, dtype.itemsize))
    return np.asarray(values * np.float32(unit), np.float32)
