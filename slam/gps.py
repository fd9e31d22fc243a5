"""GPS tracks: GPX, NMEA, CSV and GoPro's telemetry to metres, tidied, smoothed, with gaps kept as gaps.

Formats: GPX 1.0 and 1.1 (topografix.com), NMEA 0183 (GGA, RMC), GPMF (github.com/gopro/gpmf-parser).
"""

from __future__ import annotations

import csv
import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.errors import InputError, from_os_error
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.io import files, xml
from scan2sim.pipeline.io.crs import utm
from scan2sim.pipeline.types import F64, Frame

MAX_SPEED = 70.0
"""Metres a second (252 km/h) that no car drives: a fix that would need more is a jump."""
MAX_DOP = 5.0
"""Dilution of precision above which a fix is dropped (GoPro's advice)."""
RANGE_ERROR = 1.5
"""Metres of error for each unit of dilution of precision: a consumer receiver under open sky."""
QUALITY_ERROR = {2: 0.8, 4: 0.02, 5: 0.3}
"""The same by GGA's quality: differential, RTK fixed, RTK float."""
LOCAL_FRAME = Frame()
GPS_YEAR_2000 = datetime(2000, 1, 1, tzinfo=UTC).timestamp()  # GPS9 counts days from here


@dataclass(frozen=True)
class GpsTrack:
    """Where a receiver was.

    Attributes:
        times: (N,) seconds, ascending: UNIX time, or the video's own clock for telemetry inside a video.
        positions: (N, 3) metres east, north, up, local to `frame`; heights as the receiver gave them.
        sigma: (N,) metres, one standard deviation of a horizontal axis as the receiver's DOP tells it, or None.
        frame: UTM zone of the track, origin near its first fix; "local" for a file of local metres.
        epoch: UNIX time at which `times` are 0, where a video's telemetry tells it, or None.
    """

    times: F64
    positions: F64
    sigma: F64 | None = None
    frame: Frame = LOCAL_FRAME
    epoch: float | None = None

    def __len__(self) -> int:
        return len(self.times)

    def shifted(self, seconds: float) -> GpsTrack:
        """The track with `seconds` added to its times: a video that began at UNIX time t0 needs -t0."""
        return replace(self, times=self.times + seconds, epoch=None if self.epoch is None else self.epoch - seconds)

    def at(self, times: npt.ArrayLike, max_gap: float = 3.0) -> F64:
        """(M, 3) positions at `times` (M,), linearly interpolated; NaN outside and within gaps over `max_gap` s."""
        moments = np.asarray(times, np.float64)
        after = np.minimum(np.searchsorted(self.times, moments), len(self) - 1)
        before = np.maximum(after - 1, 0)
        near = self.times[after] - self.times[before] <= max_gap
        inside = (moments >= self.times[0]) & (moments <= self.times[-1]) & (near | (moments == self.times[after]))
        positions = np.stack([np.interp(moments, self.times, self.positions[:, k]) for k in range(3)], axis=-1)
        return np.where(inside[..., None], positions, np.nan)

    def distance(self, start: npt.ArrayLike, end: npt.ArrayLike, max_gap: float = 3.0) -> F64:
        """Metres as the crow flies between the positions at times `start` and `end` (M,); NaN as `at` has it.

        Short chords of a track that wasn't smoothed are mostly noise: take 1 s or 50 m at least.
        """
        return np.linalg.norm(self.at(end, max_gap) - self.at(start, max_gap), axis=-1)


def read_gps(path: Path) -> GpsTrack:
    """Read and tidy a track: sorted, each time once, without bad fixes and jumps.

    Times are UNIX seconds for GPX and NMEA, as the file says for CSV, and for a GoPro video seconds of the video.

    Raises:
        InputError: unknown suffix, unreadable, or no fix in it.
        UnavailableError: a video, and PyAV isn't installed.
    """
    reader = FORMATS.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, "is no known GPS format", f"Give one of {', '.join(FORMATS)}")
    files.check(path)
    try:
        return reader(path)
    except csv.Error as error:
        raise InputError(path, f"is no readable CSV ({error})", "Export it again") from None
    except OSError as error:
        raise from_os_error(error, path) from error


# --- formats: rows of time (s), latitude, longitude (degrees), height (m), sigma (m), NaN where not known


def read_gpx(path: Path) -> GpsTrack:
    """Track points of all tracks and segments of a GPX 1.0 or 1.1 file."""
    rows, untimed = [], 0
    for point in xml.root(path).iter():
        if _bare(point) != "trkpt":
            continue
        about = {_bare(child): (child.text or "").strip() for child in point}
        when = _seconds(about.get("time", ""))
        untimed += math.isnan(when)
        if about.get("fix") != "none":
            sigma = _sigma(_number(about.get("hdop")))
            place = (_number(point.get(key)) for key in ("lat", "lon"))
            rows.append([when, *place, _number(about.get("ele")), sigma])
    if rows and untimed == len(rows):
        raise InputError(path, "has track points, but no times", "Export the recorded track, not a route or course")
    return _located(path, rows)


def read_csv(path: Path) -> GpsTrack:
    """Columns by name: time, latitude, longitude[, altitude][, hdop or accuracy]; or time, x, y, z in local metres."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "is no text", "Write a CSV with a heading") from None
    first = text.lstrip("\n").partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    table = csv.DictReader((line for line in text.splitlines() if line.strip()), delimiter=delimiter)
    names = {re.sub(r"\W.*", "", name.strip(" #").lower()): name for name in table.fieldnames or ()}  # "lat (deg)"

    def column(*wanted: str) -> str | None:
        return next((names[name] for name in wanted if name in names), None)

    time, lat, lon = column("time", "timestamp"), column("latitude", "lat"), column("longitude", "lon", "lng")
    height, dop, accuracy = column("altitude", "alt", "ele"), column("hdop"), column("accuracy", "sigma")
    x, y, z = (column(name) for name in "xyz")
    local = lat is None or lon is None
    if time is None or (local and (x is None or y is None)):
        raise InputError(
            path, f"lacks columns (it has {first[:80]})", "Name them time,latitude,longitude,altitude or time,x,y,z"
        )
    places = (x, y, z) if local else (lat, lon, height)
    rows = []
    for row in table:
        place = [_number(row.get(name)) if name else math.nan for name in places]
        sigma = _number(row.get(accuracy)) if accuracy else _sigma(_number(row.get(dop)) if dop else math.nan)
        rows.append([_seconds(row[time] or ""), *place, sigma])
    if not local:
        return _located(path, rows)
    data = np.array(rows, np.float64).reshape(-1, 5)
    data = data[np.isfinite(data[:, :3]).all(axis=1) & ~np.isinf(data[:, 4])]
    return _track(path, data[:, 0], data[:, 1:4], data[:, 4], Frame())


def read_nmea(path: Path) -> GpsTrack:
    """GGA sentences (position, quality, HDOP), dated by the RMC nearest in time; a wrong checksum drops a sentence."""
    fixes: list[list[float]] = []  # the time still a time of day
    clocks: list[float] = []  # the last RMC's UNIX time at each fix, NaN before the first
    clock, sentences = math.nan, 0
    for line in path.read_text(encoding="ascii", errors="replace").splitlines():
        fields = _sentence(line)
        sentences += bool(fields)
        kind = fields[0][-3:] if fields else ""
        if kind == "RMC" and len(fields) > 9 and fields[2] == "A":
            clock = _nmea_date(fields[9]) + _nmea_clock(fields[1])
        elif kind == "GGA" and len(fields) > 9 and fields[6].isdigit() and int(fields[6]) in (1, 2, 3, 4, 5):
            sigma = _sigma(_number(fields[8]), QUALITY_ERROR.get(int(fields[6]), RANGE_ERROR))
            place = _nmea_angle(fields[2], fields[3]), _nmea_angle(fields[4], fields[5])
            fixes.append([_nmea_clock(fields[1]), *place, _number(fields[9]), sigma])
            clocks.append(clock)
    if not sentences:
        raise InputError(path, "holds no NMEA sentence with a right checksum", "Give the receiver's log as it was")
    if fixes and np.isnan(clocks).all():
        if math.isnan(clock):
            raise InputError(path, "has fixes, but no date (no valid RMC sentence)", "Log RMC beside GGA")
        clocks[-1] = clock  # a single RMC, after all fixes
    rows, near = np.array(fixes).reshape(-1, 5), np.array(clocks)
    if len(rows):
        known = np.flatnonzero(~np.isnan(near))
        near = near[known[np.maximum(np.searchsorted(known, np.arange(len(near)), side="right") - 1, 0)]]
        rows[:, 0] += np.round((near - rows[:, 0]) / 86400) * 86400  # the day that brings it next to that RMC
    return _located(path, rows.tolist())


def read_gopro(path: Path) -> GpsTrack:
    """Telemetry of a GoPro's MP4: its GPS9 stream, or else GPS5; times are seconds of the video's clock.

    A packet's fixes are spread evenly over its time: by the camera's stamps (STMP) where it has them, else by the
    track's time stamps. GPS9 dates every fix: its clock, moved as a whole to the video's, takes the jitter out.
    """
    packets = list(_packets(path))
    if not packets:
        raise InputError(path, "has no GoPro telemetry", "Use the file as the camera wrote it, or give a GPX")
    try:
        parts = [gpmf_fixes(data) for _, _, data in packets]
    except (ValueError, struct.error, KeyError, IndexError) as error:  # types and fields that there aren't
        raise InputError(path, f"has damaged GoPro telemetry ({error})", "Copy it from the camera again") from None
    key = "GPS9" if any("GPS9" in part for part in parts) else "GPS5"
    found = [(*packet[:2], part[key]) for packet, part in zip(packets, parts, strict=True) if key in part]
    if not found:
        raise InputError(path, "has telemetry, but no GPS", "Switch GPS on in the camera, or give a GPX")
    starts = np.array([start for start, _, _ in found])
    stamps = np.array([fixes.stamp for _, _, fixes in found])
    oldest = min((part.oldest for part in parts[0].values()), default=math.nan)
    if np.isfinite([*stamps, oldest]).all() and (np.diff(stamps) > 0).all():
        starts = packets[0][0] + stamps - oldest
    spans = np.diff(starts, append=starts[-1] + found[-1][1])
    if len(spans) > 1:
        spans = np.minimum(spans, 1.5 * np.median(spans[:-1]))  # a packet lost leaves a gap
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
    table = np.column_stack([times, rows[:, :3], RANGE_ERROR * rows[:, 3]])[good]
    known = epoch[np.isfinite(epoch)]
    return replace(_located(path, table.tolist()), epoch=float(np.median(known)) if len(known) else None)


FORMATS: dict[str, Callable[[Path], GpsTrack]] = {
    ".gpx": read_gpx,
    ".csv": read_csv,
    ".nmea": read_nmea,
    ".txt": read_nmea,
    ".log": read_nmea,
    ".mp4": read_gopro,
    ".mov": read_gopro,
    ".360": read_gopro,
    ".lrv": read_gopro,
}


def _bare(element: Element) -> str:
    """An element's tag without its name space."""
    return str(element.tag).rpartition("}")[2]


def _number(text: str | None) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan


def _seconds(text: str) -> float:
    """Seconds of a number, or UNIX seconds of an ISO 8601 time (UTC where it names no zone); NaN for neither."""
    value = _number(text)
    if math.isnan(value):
        try:
            moment = datetime.fromisoformat(text.strip())
        except ValueError:
            return math.nan
        value = moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
    return value


def _sigma(dop: float, unit: float = RANGE_ERROR) -> float:
    """Metres of a dilution of precision; infinite where it is too high to use, NaN for the 0 of one not known."""
    return math.inf if dop > MAX_DOP else unit * dop if dop > 0 else math.nan


def _sentence(line: str) -> list[str]:
    """The fields of an NMEA sentence; none if its checksum is absent or wrong."""
    body, star, given = line.strip().partition("$")[2].partition("*")
    total = 0
    for character in body:
        total ^= ord(character)
    return body.split(",") if star and given[:2].upper() == f"{total:02X}" else []


def _nmea_angle(text: str, side: str) -> float:
    """Degrees of (d)ddmm.mmmm."""
    value = _number(text)
    degrees = value // 100
    return (degrees + (value - 100 * degrees) / 60) * (-1 if side in ("S", "W") else 1)


def _nmea_clock(text: str) -> float:
    """Seconds of the day of hhmmss.ss."""
    return 3600 * _number(text[:2]) + 60 * _number(text[2:4]) + _number(text[4:])


def _nmea_date(text: str) -> float:
    """UNIX time of the beginning of ddmmyy."""
    try:
        return datetime.strptime(text, "%d%m%y").replace(tzinfo=UTC).timestamp()
    except ValueError:
        return math.nan


# --- GoPro's key-length-value telemetry


@dataclass(frozen=True)
class GpmfFixes:
    """The fixes of one telemetry packet.

    Attributes:
        rows: (N, 5) latitude, longitude (degrees), height (m), dilution of precision or NaN, fix (0, 2 or 3).
        clock: (N,) UNIX seconds by the receiver, NaN where it doesn't tell (GPS5).
        stamp: seconds of the camera's clock at the first fix, or NaN.
        oldest: the least stamp of all the packet's streams, or NaN.
        utc: UNIX seconds that the packet itself is dated (GPSU), or NaN.
    """

    rows: F64
    clock: F64
    stamp: float
    oldest: float
    utc: float


NUMBERS = {"b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
           "f": ">f4", "d": ">f8"}  # fmt: skip


def gpmf_fixes(packet: bytes) -> dict[str, GpmfFixes]:
    """The fixes of a telemetry packet by their stream, "GPS5" or "GPS9"; empty where it has none.

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
    """Key, type, size of a sample and payload of the entries that stand one after another in `data`."""
    at = 0
    while at + 8 <= len(data) and data[at] != 0:
        key, kind, size, repeat = struct.unpack_from(">4scBH", data, at)
        end = at + 8 + size * repeat
        if end > len(data):
            raise ValueError(f"{key!r} is cut short")
        yield key.decode("latin-1"), kind.decode("latin-1"), size, data[at + 8 : end]
        at = end + -(size * repeat) % 4


Stream = dict[str, tuple[str, int, bytes]]


def _first(stream: Stream, key: str, default: float = math.nan) -> float:
    """The first number of an entry."""
    if key not in stream:
        return default
    kind, _, body = stream[key]
    return float(np.frombuffer(body, NUMBERS[kind], 1)[0])


def _utc(stream: Stream) -> float:
    """GPSU: yymmddhhmmss.sss."""
    text = stream["GPSU"][2].decode("latin-1") if "GPSU" in stream else ""
    try:
        return datetime.strptime(text[:12], "%y%m%d%H%M%S").replace(tzinfo=UTC).timestamp() + float(text[12:] or 0)
    except ValueError:
        return math.nan


def _samples(stream: Stream, key: str, width: int) -> F64:
    """(N, width) the numbers of an entry, divided by SCAL; a `?` entry is laid out as TYPE says."""
    kind, size, body = stream[key]
    letters = stream["TYPE"][2].decode("latin-1").rstrip("\0") if kind == "?" and "TYPE" in stream else kind * width
    if len(letters) != width or not set(letters) <= set(NUMBERS):
        raise ValueError(f"{key} is of the unknown type {letters!r}")
    layout = np.dtype([(str(k), NUMBERS[letter]) for k, letter in enumerate(letters)])
    if layout.itemsize != size:
        raise ValueError(f"{key} has samples of {size} bytes, expected {layout.itemsize}")
    table = np.frombuffer(body, layout)
    values = np.stack([table[name].astype(np.float64) for name in layout.names or ()], axis=1)
    if "SCAL" not in stream:
        raise ValueError(f"{key} has no scale")
    scale_kind, _, scale = stream["SCAL"]
    return values / np.frombuffer(scale, NUMBERS[scale_kind]).astype(np.float64)


def _packets(path: Path) -> Iterator[tuple[float, float, bytes]]:
    """Start (s), length (s) and payload of the telemetry packets of a video."""
    need("telemetry of a video", "av")
    import av

    try:
        with av.open(str(path)) as video:
            tracks = [stream for stream in video.streams if stream.type == "data"]
            for packet in video.demux(tracks) if tracks else ():
                data = bytes(packet)
                if packet.pts is not None and data[:4] == b"DEVC":  # other data tracks hold time codes
                    tick = float(packet.time_base)
                    yield packet.pts * tick, (packet.duration or round(1 / tick)) * tick, data
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        raise InputError(path, f"is no readable video ({error})", "Copy it again") from None


# --- tidying


def _located(path: Path, rows: Sequence[Sequence[float]]) -> GpsTrack:
    """The track of rows of time, latitude, longitude, height, sigma, in the UTM zone that it is in."""
    from pyproj import Transformer

    data = np.array(rows, np.float64).reshape(-1, 5)
    time, lat, lon, height, sigma = data.T
    null = (lat == 0) & (lon == 0)  # what receivers write before their first fix
    data = data[np.isfinite(time) & (np.abs(lat) <= 84) & (np.abs(lon) <= 180) & ~null & ~np.isinf(sigma)]
    if not len(data):
        raise InputError(path, f"has no usable GPS fix ({len(rows)} points)", "Give a track with times and positions")
    time, lat, lon, height, sigma = data.T
    middle = data[np.argsort(lon)[len(data) // 2]]  # one wild fix doesn't choose the zone
    crs = utm(middle[1], middle[2])
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    known = np.isfinite(height)
    order = np.argsort(time[known], kind="stable")
    height = np.interp(time, time[known][order], height[known][order]) if known.any() else np.zeros(len(time))
    return _track(path, time, np.column_stack([east, north, height]), sigma, Frame(crs))


def _track(path: Path, times: F64, positions: F64, sigma: F64, frame: Frame) -> GpsTrack:
    """The tidy track of fixes in CRS metres: sorted, each time once, no jumps, local to its first fix."""
    if not len(times):
        raise InputError(path, "has no usable GPS fix", "Give a track with times and positions")
    _, order = np.unique(times, return_index=True)
    keep = order[without_jumps(times[order], positions[order, :2])]
    times, positions, sigma = times[keep], np.where(np.isfinite(positions[keep]), positions[keep], 0.0), sigma[keep]
    if frame.crs != "local":
        x, y, z = np.floor(positions[0]).tolist()
        frame = Frame(frame.crs, (x, y, z))
        positions = frame.to_local(positions)
    known = sigma > 0
    return GpsTrack(times, positions, np.where(known, sigma, RANGE_ERROR) if known.any() else None, frame)


def without_jumps(times: F64, xy: F64, max_speed: float = MAX_SPEED, reach: int = 1000) -> npt.NDArray[np.int64]:
    """Indices of the most fixes of (N,) `times` and (N, 2) `xy` that one can pass through at `max_speed` (m/s).

    The longest chain rather than the first: a wrong start doesn't take the rest with it. `reach` is the number of
    fixes to look back at for the one before, all of them where none of those will do.
    """
    if (np.hypot(*np.diff(xy, axis=0).T) <= max_speed * np.diff(times)).all():
        return np.arange(len(times))
    length, before = np.ones(len(times), int), np.full(len(times), -1)
    for i in range(1, len(times)):
        for low, high in ((max(0, i - reach), i), (0, max(0, i - reach))):
            away = np.hypot(xy[low:high, 0] - xy[i, 0], xy[low:high, 1] - xy[i, 1])
            possible = np.flatnonzero(away <= max_speed * (times[i] - times[low:high]))
            if len(possible):
                best = low + possible[len(possible) - 1 - np.argmax(length[low + possible][::-1])]
                length[i], before[i] = length[best] + 1, best
                break
    chain = [int(np.argmax(length))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


# --- smoothing


def smooth(track: GpsTrack, seconds: float = 1.0, max_gap: float = 3.0) -> GpsTrack:
    """The track through a robust local parabola about every fix; gaps over `max_gap` seconds are not smoothed across.

    LOWESS (Cleveland 1979) of degree 2: neighbours weigh by a Gaussian of `seconds`, and fixes that stray from their
    neighbours' curve lose their weight. `sigma` stays: a receiver's error hardly changes within seconds.
    """
    return replace(track, positions=_lowess(track, seconds, max_gap)[0])


def noise(track: GpsTrack, seconds: float = 1.5, max_gap: float = 3.0) -> float:
    """Metres, one standard deviation of a horizontal axis: how far fixes scatter about their smoothed path.

    Robust (median absolute deviation), of what changes within some 6 x `seconds`. Slower errors, which are the larger
    part of a receiver's, can't be told from driving: the true error is at least this.
    """
    smoothed, leverage = _lowess(track, seconds, max_gap)
    free = leverage < 0.9  # the ends of stretches follow their fixes whatever they say
    scatter = (track.positions - smoothed)[free, :2] / np.sqrt(1 - leverage[free])[:, None]
    return float(1.4826 * np.median(np.abs(scatter))) if free.any() else 0.0


def _lowess(track: GpsTrack, seconds: float, max_gap: float, rounds: int = 3) -> tuple[F64, F64]:
    """(N, 3) smoothed positions, and (N,) the weight of each fix in its own."""
    times, positions = track.times, track.positions
    n = len(times)
    stretch = np.concatenate([[0], np.cumsum(np.diff(times) > max_gap)])
    first, last = np.searchsorted(times, times - 3 * seconds), np.searchsorted(times, times + 3 * seconds)
    offsets = np.arange(int((last - first).max()))
    trust = np.ones(n) if track.sigma is None else (np.median(track.sigma) / np.maximum(track.sigma, 1e-3)) ** 2
    smoothed, leverage, robust = positions.copy(), np.zeros(n), np.ones(n)
    for _ in range(rounds):
        for block in np.array_split(np.arange(n), math.ceil(n * len(offsets) / 1e6)):
            near = np.minimum(first[block, None] + offsets, n - 1)
            inside = (first[block, None] + offsets < last[block, None]) & (stretch[near] == stretch[block, None])
            t = (times[near] - times[block, None]) / seconds
            weight = np.where(inside, np.exp(-0.5 * t * t) * trust[near] * robust[near], 0.0)
            basis = np.stack([np.ones_like(t), t, t * t], axis=-1)
            normal = np.einsum("bn,bni,bnj->bij", weight, basis, basis)
            normal += 1e-9 * np.eye(3) * np.maximum(weight.sum(axis=1), 1e-9)[:, None, None]  # fewer than three near
            ahead = positions[near] - positions[block, None]
            right = np.einsum("bn,bni,bnk->bik", weight, basis, ahead)
            inverse = np.linalg.inv(normal)
            smoothed[block] = positions[block] + np.einsum("bi,bik->bk", inverse[:, 0], right)
            leverage[block] = np.minimum(inverse[:, 0, 0] * trust[block] * robust[block], 1.0)
        own = np.linalg.norm((positions - smoothed)[:, :2], axis=1)
        alone = own / np.maximum(1 - leverage, 0.05)  # as if the fix had had no say in its own place
        scale = max(1.4826 * float(np.median(alone)), 0.1)
        robust = np.maximum(1 - (alone / (6 * scale)) ** 2, 1e-6) ** 2
    return smoothed, leverage
