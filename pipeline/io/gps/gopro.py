"""GPS tracks from GoPro telemetry in videos: GPMF (github.com/gopro/gpmf-parser)."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.pipeline.io.gps_fixes import MAX_DOP, RANGE_ERROR_M, track_from_wgs84

SUFFIXES = (".mp4", ".mov", ".360", ".lrv")
NEEDS = ("av",)
GPS_YEAR_2000 = datetime(2000, 1, 1, tzinfo=UTC).timestamp()  # GPS9 counts days from here


def read(path: Path) -> GpsTrack:
    """GPS track of a GoPro MP4: the GPS9 stream, or else GPS5; times are seconds of the video's clock.

    The fixes of a packet are spread evenly over its duration: by the camera's time stamps (STMP) if it has them, else
    by those of the video track. GPS9 dates every fix; its clock, shifted to the video's by the median, removes the
    jitter.
    """
    packets = list(_packets(path))
    if not packets:
        raise InputError(path, "has no GoPro telemetry", "Use the original file of the camera, or give a GPX")
    try:
        parts = [gpmf_fixes(data) for _, _, data in packets]
    except (ValueError, struct.error, KeyError, IndexError) as error:  # unknown types, missing fields
        raise InputError(path, f"has damaged GoPro telemetry ({error})", "Copy it from the camera again") from None
    key = "GPS9" if any("GPS9" in part for part in parts) else "GPS5"
    found = [(*packet[:2], part[key]) for packet, part in zip(packets, parts, strict=True) if key in part]
    if not found:
        raise InputError(path, "has telemetry, but no GPS", "Enable GPS in the camera, or give a GPX")
    starts = np.array([start for start, _, _ in found])
    stamps = np.array([fixes.stamp for _, _, fixes in found])
    oldest = min((part.oldest for part in parts[0].values()), default=math.nan)
    if np.isfinite([*stamps, oldest]).all() and (np.diff(stamps) > 0).all():
        starts = packets[0][0] + stamps - oldest
    spans = np.diff(starts, append=starts[-1] + found[-1][1])
    if len(spans) > 1:
        spans = np.minimum(spans, 1.5 * np.median(spans[:-1]))  # don't stretch fixes over the gap of a lost packet
    times = np.concatenate(
        [s + np.arange(len(f.rows)) / len(f.rows) * d for s, d, (_, _, f) in zip(starts, spans, found, strict=True)]
    )
    rows = np.concatenate([fixes.rows for _, _, fixes in found])
    good = (rows[:, 4] >= 2) & ~(rows[:, 3] > MAX_DOP)
    clock = np.concatenate([fixes.clock for _, _, fixes in found])
    epoch = np.array([fixes.utc for _, _, fixes in found]) - starts
    if good.any() and np.isfinite(clock[good]).all():
        epoch = (clock - times)[good]
        times = clock - np.median(epoch)
    table = np.column_stack([times, rows[:, :3], RANGE_ERROR_M * rows[:, 3]])[good]
    known = epoch[np.isfinite(epoch)]
    return replace(track_from_wgs84(path, table.tolist()), epoch=float(np.median(known)) if len(known) else None)


@dataclass(frozen=True)
class GpmfFixes:
    """The fixes of one telemetry packet.

    Attributes:
        rows: (N, 5) latitude, longitude (degrees), height (m), dilution of precision or NaN, fix type (0, 2 or 3).
        clock: (N,) UNIX seconds of the receiver, NaN if unknown (GPS5).
        stamp: camera clock at the first fix, seconds, or NaN.
        oldest: smallest stamp of all streams of the packet, or NaN.
        utc: date of the packet (GPSU), UNIX seconds, or NaN.
    """

    rows: F64
    clock: F64
    stamp: float
    oldest: float
    utc: float


GPMF_DTYPES = {"b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
           "f": ">f4", "d": ">f8"}  # fmt: skip


def gpmf_fixes(packet: bytes) -> dict[str, GpmfFixes]:
    """The fixes of a telemetry packet by their stream, "GPS5" or "GPS9"; empty if it has none.

    Raises:
        ValueError: the packet is damaged.
    """
    streams = [
        {key: (kind, size, body) for key, kind, size, body in _entries(stream)}
        for device, _, _, inside in _entries(packet)
        if device == "DEVC"
        for name, _, _, stream in _entries(inside)
        if name == "STRM"
    ]
    oldest = min((_first(s, "STMP") * 1e-6 for s in streams if "STMP" in s), default=math.nan)
    found = {}
    for s in streams:
        stamp, utc = _first(s, "STMP") * 1e-6, _utc(s)
        for key, width in (("GPS5", 5), ("GPS9", 9)):
            if key not in s or not len(s[key][2]):
                continue
            values = _samples(s, key, width)
            n = len(values)
            if key == "GPS5":
                quality = np.full((n, 1), _first(s, "GPSP") / 100), np.full((n, 1), _first(s, "GPSF", 3.0))
                clock = np.full(n, math.nan)
            else:
                quality = values[:, 7:8], values[:, 8:9]
                clock = GPS_YEAR_2000 + 86400 * values[:, 5] + values[:, 6]
            found[key] = GpmfFixes(np.hstack([values[:, :3], *quality]), clock, stamp, oldest, utc)
    return found


def _entries(data: bytes) -> Iterator[tuple[str, str, int, bytes]]:
    """Key, type, sample size and payload of the consecutive entries (KLV) in `data`."""
    at = 0
    while at + 8 <= len(data) and data[at] != 0:
        key, kind, size, repeat = struct.unpack_from(">4scBH", data, at)
        end = at + 8 + size * repeat
        if end > len(data):
            raise ValueError(f"{key!r} is truncated")
        yield key.decode("latin-1"), kind.decode("latin-1"), size, data[at + 8 : end]
        at = end + -(size * repeat) % 4


Stream = dict[str, tuple[str, int, bytes]]


def _first(stream: Stream, key: str, default: float = math.nan) -> float:
    """The first number of an entry."""
    if key not in stream:
        return default
    kind, _, body = stream[key]
    return float(np.frombuffer(body, GPMF_DTYPES[kind], 1)[0])


def _utc(stream: Stream) -> float:
    """UNIX seconds of GPSU (yymmddhhmmss.sss), or NaN."""
    text = stream["GPSU"][2].decode("latin-1") if "GPSU" in stream else ""
    try:
        return datetime.strptime(text[:12], "%y%m%d%H%M%S").replace(tzinfo=UTC).timestamp() + float(text[12:] or 0)
    except ValueError:
        return math.nan


def _samples(stream: Stream, key: str, width: int) -> F64:
    """Numbers (N, width) of an entry, divided by SCAL; TYPE describes the layout of a `?` entry."""
    kind, size, body = stream[key]
    letters = stream["TYPE"][2].decode("latin-1").rstrip("\0") if kind == "?" and "TYPE" in stream else kind * width
    if len(letters) != width or not set(letters) <= set(GPMF_DTYPES):
        raise ValueError(f"{key} has the unknown type {letters!r}")
    layout = np.dtype([(str(k), GPMF_DTYPES[letter]) for k, letter in enumerate(letters)])
    if layout.itemsize != size:
        raise ValueError(f"{key} has samples of {size} bytes, expected {layout.itemsize}")
    table = np.frombuffer(body, layout)
    values = np.stack([table[name].astype(np.float64) for name in layout.names or ()], axis=1)
    if "SCAL" not in stream:
        raise ValueError(f"{key} has no scale")
    scale_kind, _, scale = stream["SCAL"]
    return values / np.frombuffer(scale, GPMF_DTYPES[scale_kind]).astype(np.float64)


def _packets(path: Path) -> Iterator[tuple[float, float, bytes]]:
    """Start (s), length (s) and payload of the telemetry packets of a video."""
    require("telemetry of a video", "av")
    import av

    try:
        with av.open(str(path.absolute())) as video:
            tracks = [stream for stream in video.streams if stream.type == "data"]
            for packet in video.demux(tracks) if tracks else ():
                data = bytes(packet)
                if packet.pts is not None and data[:4] == b"DEVC":  # other data tracks contain time codes
                    tick = float(packet.time_base)
                    yield packet.pts * tick, (packet.duration or round(1 / tick)) * tick, data
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not a readable video ({error})", "Copy it again") from None
