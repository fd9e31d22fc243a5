"""Sweeps of `sensor_msgs/PointCloud2` messages: any layout of fields, data types and byte order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, U8

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""`PointField.datatype` to NumPy's type."""
TIME_FIELDS = (
    "time", "t", "timestamp", "time_stamp", "timestamps", "offset_time", "time_offset", "point_time", "ts", "dt",
)  # fmt: skip
"""Names of the field with the time of a point: Velodyne `time`, Ouster `t`, Hesai and Robosense `timestamp`, Livox
`offset_time` or `timestamp`, Seyond and Luminar `time_offset`."""
TIME_WORDS = re.compile("time|stamp")
"""Part of other names of that field, such as Blickfeld's `point_time_offset`, Aeva's `time_offset_ns`."""
SECONDS = re.compile("(?<!n)(?<!u)(?<!nano)(?<!micro)(?<!milli)(_s|_?secs?|_?seconds?)$")
"""End of the name of a field with whole seconds; another field may have the rest."""
SECOND_PARTS = (("_?(ns|nsecs?|nanosecs?|nanoseconds?)", 1), ("_?(us|usecs?|microsecs?|microseconds?)", 1000))
"""End of the name of the field with the rest of a second, and its unit in nanoseconds."""
INTENSITY_FIELDS = ("intensity", "reflectivity", "i", "signal", "intensities")
COLOUR_FIELDS = ("rgb", "rgba")
MIN_SPAN_S, MAX_OFFSET_S = 1e-3, 0.99
"""Plausible duration of a sweep, by which the unit of its points' times is recognized: `deskew` accepts up to 1 s."""
FLOAT_UNITS_S, INTEGER_UNITS_S = (1.0, 1e-6, 1e-9, 1e-3), (1e-9, 1e-6, 1e-3)
"""Units of times in the order in which they are tried; the first plausible one counts."""


class InvalidCloud(Exception):
    """A cloud whose data don't fit its description; the text says why."""


@dataclass(frozen=True)
class RawSweep:
    """Points of a message, in the axes of its sensor; points without an echo (NaN or zero) are removed.

    Attributes:
        xyz: (N, 3) metres.
        intensity: (N,) in the sensor's own range, or None.
        rgb: (N, 3), or None.
        time: (N,) in the unit and clock of the sensor, or None.
    """

    xyz: F32
    intensity: npt.NDArray[Any] | None = None
    rgb: U8 | None = None
    time: npt.NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class TimeUnit:
    """How times of points are given.

    Attributes:
        seconds: duration of one unit.
        absolute: they are in the clock of the messages' headers; otherwise relative to the message's time.
        other_clock: they are in another clock: relative to the first point, which has the message's time.
    """

    seconds: float
    absolute: bool = False
    other_clock: bool = False

    def offsets(self, time: npt.NDArray[Any], stamp_ns: int) -> F64:
        """Seconds (N,) of points after the time stamp of their message."""
        if self.other_clock:
            return (time - time.min()).astype(np.float64) * self.seconds
        if not self.absolute:
            return time.astype(np.float64) * self.seconds
        if time.dtype.kind in "iu":  # nanoseconds since 1970 don't fit into a float64 without rounding
            return 1e-9 * (time.astype(np.int64) * round(self.seconds * 1e9) - stamp_ns).astype(np.float64)
        return time.astype(np.float64) * self.seconds - stamp_ns * 1e-9


def decode(cloud: Any) -> RawSweep:
    """The points of a message.

    Raises:
        InvalidCloud: it has no x, y and z, or its data don't fit the fields.
    """
    rows = _rows(cloud)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InvalidCloud(f"has no fields x, y and z (it has {', '.join(names) or 'none'})")
    xyz = np.empty((len(rows), 3), np.float32)
    for k, axis in enumerate("xyz"):
        xyz[:, k] = rows[axis]
    keep = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    time = _times(rows)
    if time is not None and time.dtype.kind == "f":
        keep &= np.isfinite(time)
    rows, xyz = rows[keep], xyz[keep]
    intensity, colour = (_first(rows, names) for names in (INTENSITY_FIELDS, COLOUR_FIELDS))
    return RawSweep(xyz, intensity, None if colour is None else _rgb(colour), None if time is None else time[keep])


def _times(rows: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
    """Times (N,) of points as the sensor gives them: one field, or whole seconds and the rest (as nanoseconds)."""
    known = _first(rows, TIME_FIELDS)
    if known is not None:
        return known
    fields = [name for name in rows.dtype.names or () if TIME_WORDS.search(name) and rows.dtype[name].ndim == 0]
    for name in fields:
        seconds = SECONDS.search(name)
        if rows.dtype[name].kind not in "iu" or not seconds:
            continue
        for end, nanoseconds in SECOND_PARTS:
            for other in fields:
                if re.fullmatch(re.escape(name[: seconds.start()]) + end, other):
                    return rows[name].astype(np.int64) * 10**9 + rows[other].astype(np.int64) * nanoseconds
    return _first(rows, [name for name in fields if rows.dtype[name].kind == "f" or not SECONDS.search(name)])


def _rows(cloud: Any) -> npt.NDArray[Any]:
    """The points (N,) as records, a view of the message's data."""
    order = ">" if cloud.is_bigendian else "<"
    names, kinds, offsets = [], [], []
    for field in cloud.fields:
        if field.datatype not in DATATYPES:
            raise InvalidCloud(f"has a field {field.name!r} of the unknown data type {field.datatype}")
        if field.name and field.name.lower() not in names:
            shape = (field.count,) if field.count > 1 else ()
            names.append(field.name.lower())
            kinds.append((f"{order}{DATATYPES[field.datatype]}", shape))
            offsets.append(field.offset)
    try:
        row = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step})
    except (ValueError, TypeError) as error:
        raise InvalidCloud(f"has fields that don't fit its points ({error})") from None
    data = np.frombuffer(cloud.data, np.uint8)
    width, height = int(cloud.width), int(cloud.height)
    stride = int(cloud.row_step) if height > 1 else width * cloud.point_step
    if width * cloud.point_step > stride or (height - 1) * stride + width * cloud.point_step > len(data):
        raise InvalidCloud(f"has {len(data)} bytes for {width} x {height} points of {cloud.point_step} bytes")
    if not width * height:
        return np.zeros(0, row)
    used = data[: height * stride]
    if len(used) < height * stride:  # the last row without its padding
        used = np.pad(used, (0, height * stride - len(used)))
    lines = used.reshape(height, stride)[:, : width * cloud.point_step]
    return np.ascontiguousarray(lines).reshape(-1).view(row)


def _first(rows: npt.NDArray[Any], names: Sequence[str]) -> npt.NDArray[Any] | None:
    own = rows.dtype.names or ()
    return next((rows[name] for name in names if name in own and rows[name].ndim == 1), None)


def _rgb(packed: npt.NDArray[Any]) -> U8:
    """Colours (N, 3) packed as 0xAARRGGBB in four bytes (PCL)."""
    bits = np.ascontiguousarray(packed).astype(packed.dtype.newbyteorder("="))
    bits = bits.view(np.uint32) if bits.dtype.itemsize == 4 else bits.astype(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)


def time_unit(time: npt.NDArray[Any], stamp_ns: int) -> TimeUnit | None:
    """Recognize the unit and clock of the times (N,) of a sweep's points; None if no unit is plausible.

    Args:
        time: as in the message.
        stamp_ns: time of the message, nanoseconds.
    """
    span = float(time.max() - time.min()) if len(time) else 0.0
    units = FLOAT_UNITS_S if time.dtype.kind == "f" else INTEGER_UNITS_S
    for seconds in units:
        if not MIN_SPAN_S <= span * seconds <= MAX_OFFSET_S:
            continue
        for unit in (TimeUnit(seconds), TimeUnit(seconds, absolute=True)):
            if np.abs(unit.offsets(time, stamp_ns)).max() <= MAX_OFFSET_S:
                return unit
        return TimeUnit(seconds, other_clock=True)
    return None


def intensity_scale(intensity: npt.NDArray[Any]) -> float:
    """Factor that scales a sensor's intensities to 0..1, by their type and the largest of a sweep."""
    kind = intensity.dtype
    if kind.kind in "iu" and kind.itemsize <= 2:
        return 1 / np.iinfo(kind).max
    largest = float(np.nan_to_num(intensity.astype(np.float64)).max(initial=0))
    return 1.0 if largest <= 1 else 1 / 255 if largest <= 255 else 1 / 65535
