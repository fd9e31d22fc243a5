"""Chunked reading of point clouds, shared by all readers but LAS's.

A reader yields `Points`: CRS coordinates in float64, colours and intensities in the file's own range. This module
turns them into `PointCloud`s: 8-bit colours and 16-bit intensities, scaled by one factor per scan. A cloud has the
attributes that any of its points have; points without them are grey, of intensity 0 or unclassified, and counted.
Withheld points and points without finite coordinates (PCD and E57 mark beams without an echo that way) are removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import UNCLASSIFIED
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8, UNCOLOURED, Bools, Frame, PointCloud

READ_POINTS = 500_000
"""Points that readers hold in memory at a time."""
PTS_INTENSITIES = (-2048.0, 2047.0)
"""Range of intensities in Leica's PTS and PTX files."""


@dataclass(frozen=True)
class Points:
    """A chunk of a file's points.

    Attributes:
        xyz: (N, 3) float64, CRS coordinates.
        rgb: (N, 3) values in 0..1, 0..255 or 0..65535, NaN where a point has no colour, or None.
        classification: (N,) LAS codes, or None.
        time: (N,) seconds, or None.
        intensity: (N,) values in 0..1, 0..255, 0..65535 or `PTS_INTENSITIES`, or None.
        withheld: (N,) bool, points that must not be used, or None.
        scan: number of the scan; colours and intensities of one scan have one range.
    """

    xyz: F64
    rgb: npt.NDArray[Any] | None = None
    classification: npt.NDArray[Any] | None = None
    time: npt.NDArray[Any] | None = None
    intensity: npt.NDArray[Any] | None = None
    withheld: Bools | None = None
    scan: int = 0

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, index: npt.NDArray[Any] | slice) -> Points:
        """The points selected by `index` (mask, integers or slice)."""
        parts = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "scan"}
        return Points(**{key: value[index] for key, value in parts.items() if value is not None}, scan=self.scan)


@dataclass
class _Scan:
    """A scan's number of coloured points, its largest colour value, and smallest and largest intensity."""

    coloured: int = 0
    rgb: float = 0.0
    low: float = np.inf
    high: float = -np.inf


@dataclass
class Summary:
    """Statistics of a file.

    Attributes:
        count: number of points that are used: finite and not withheld.
        low, high: (3,) bounds, CRS units.
        withheld: number of withheld points.
        scans: range of colours and intensities of each scan.
        having: number of points that have an intensity, a class, a time.
        timed: whether a time isn't 0.
        no_codes: number of points whose class is no LAS code, and an example.
    """

    count: int = 0
    low: F64 = field(default_factory=lambda: np.full(3, np.inf))
    high: F64 = field(default_factory=lambda: np.full(3, -np.inf))
    withheld: int = 0
    scans: dict[int, _Scan] = field(default_factory=dict)
    having: dict[str, int] = field(default_factory=dict)
    timed: bool = False
    no_codes: tuple[int, float] = (0, 0.0)

    def add(self, part: Points) -> Points:
        """Add a chunk; returns its points that are used."""
        if part.withheld is not None and part.withheld.any():
            self.withheld += int(part.withheld.sum())
            part = part.take(~part.withheld)
        good = np.asarray(np.isfinite(part.xyz).all(axis=1))
        part = part if good.all() else part.take(good)
        if not len(part):
            return part
        self.count += len(part)
        self.low, self.high = np.minimum(self.low, part.xyz.min(axis=0)), np.maximum(self.high, part.xyz.max(axis=0))
        scan = self.scans.setdefault(part.scan, _Scan())
        if part.rgb is not None:
            scan.rgb = max(scan.rgb, _extremes(part.rgb)[1])
            scan.coloured += int(np.isfinite(part.rgb).all(axis=1).sum())
        if part.intensity is not None:
            low, high = _extremes(part.intensity)
            scan.low, scan.high = min(scan.low, low), max(scan.high, high)
        if part.classification is not None and (wrong := ~_are_codes(part.classification)).any():
            self.no_codes = self.no_codes[0] + int(wrong.sum()), float(part.classification[wrong][0])
        if part.time is not None:
            self.timed |= bool(np.nan_to_num(part.time).any())
        for name in ("intensity", "classification", "time"):
            self.having[name] = self.having.get(name, 0) + (0 if getattr(part, name) is None else len(part))
        return part

    def has(self, name: str) -> bool:
        """Whether the cloud has an attribute: some points have it, and of times all."""
        if name == "rgb":
            return any(scan.rgb > 0 for scan in self.scans.values())  # 0: fields that were never filled
        if name == "intensity":
            return any(scan.high > 0 or scan.low < -1 for scan in self.scans.values())
        if name == "time":
            return self.timed and self.having["time"] == self.count
        return self.having[name] > 0

    @property
    def notes(self) -> tuple[str, ...]:
        """Points that were left out, attributes that some points don't have, and unusual ranges."""
        found = []
        if self.withheld:
            found.append(f"{self.withheld:,} withheld points are not used")
        coloured = sum(scan.coloured for scan in self.scans.values() if scan.rgb > 0)
        texts = (
            ("rgb", "have no colour: they are grey until photos or neighbours colour them"),
            ("intensity", "have no intensity: it is taken as 0"),
            ("classification", "have no class: they are unclassified"),
        )
        for name, text in texts:
            missing = self.count - (coloured if name == "rgb" else self.having[name])
            if self.has(name) and missing:
                found.append(f"{missing:,} of {self.count:,} points {text}")
        if self.timed and self.having["time"] < self.count:
            missing = self.count - self.having["time"]
            found.append(f"{missing:,} of {self.count:,} points have no time: the times of the others are not used")
        if self.no_codes[0]:
            number, example = self.no_codes
            found.append(
                f"{number:,} points have classes that are no LAS codes, such as {example:.0f}: unclassified; renumber "
                "them to 0 to 255 to use --classes"
            )
        low = min((scan.low for scan in self.scans.values()), default=0.0)
        if self.has("intensity") and low < -1:
            high = max(scan.high for scan in self.scans.values())
            found.append(f"intensities from {low:g} to {high:g} are scaled to 0 to 65535")
        return tuple(found)


def summary(path: Path, parts: Iterable[Points]) -> Summary:
    """Statistics over all chunks of a file.

    Raises:
        InputError: no point can be used.
    """
    found = Summary()
    for part in parts:
        found.add(part)
    return _checked(path, found)


def read_all(path: Path, parts: Iterable[Points], frame: Frame) -> PointCloud:
    """All points in `frame`'s local coordinates.

    Raises:
        InputError: no point can be used.
    """
    found, kept = Summary(), list[Points]()
    for part in parts:
        used = found.add(part)
        kept.append(replace(used, xyz=frame.to_local(used.xyz).astype(np.float32)))  # half the memory
    _checked(path, found)
    columns = [_columns(part, found) for part in kept]
    joined = {
        name: None if columns[0][name] is None else np.concatenate([one[name] for one in columns])
        for name in columns[0]
    }
    return PointCloud(frame, np.concatenate([part.xyz for part in kept]).astype(np.float32, copy=False), **joined)


def read_chunks(parts: Iterable[Points], found: Summary, frame: Frame, size: int) -> Iterator[PointCloud]:
    """The points in file order, at most `size` per chunk, each chunk in a frame with its origin near its points."""
    again = Summary()
    for part in map(again.add, parts):
        for at in range(0, len(part), size):
            chunk = part.take(slice(at, at + size))
            x, y, z = np.floor(chunk.xyz.mean(axis=0) * frame.unit).tolist()
            near = replace(frame, origin=(x, y, z))
            yield PointCloud(near, near.to_local(chunk.xyz).astype(np.float32), **_columns(chunk, found))


def to_uint16(levels: npt.NDArray[Any], low: float, high: float) -> npt.NDArray[np.uint16]:
    """Scale intensities to 0..65535, NaN to 0.

    Args:
        levels: (N,) intensities.
        low, high: of the whole scan. A scan of 1 or less, of 255 or less, or of 65535 or less has that range; one with
            negative values has `PTS_INTENSITIES` if they contain it, otherwise low to high.
    """
    values = levels.astype(np.float64)
    if low < -1:  # -1 is a mark of unknown intensities
        if PTS_INTENSITIES[0] <= low and high <= PTS_INTENSITIES[1] and high > 255:
            low, high = PTS_INTENSITIES
        factor, values = 65535 / max(high - low, 1e-9), values - low
    else:
        factor = 65535 if high <= 1 else 257 if high <= 255 else 1 if high <= 65535 else 65535 / high
    return np.clip(np.rint(np.nan_to_num(values) * factor), 0, 65535).astype(np.uint16)


def _columns(part: Points, found: Summary) -> dict[str, Any]:
    """Attributes of a chunk as `PointCloud` has them: those that the cloud has, filled where the chunk has none."""
    n, scan = len(part), found.scans.get(part.scan, _Scan())
    columns: dict[str, Any] = dict.fromkeys(("rgb", "classification", "time", "intensity"))
    if found.has("rgb"):
        missing = part.rgb is None or not scan.rgb > 0
        columns["rgb"] = np.full((n, 3), UNCOLOURED, np.uint8) if missing else _to_uint8(part.rgb, scan.rgb)
    if found.has("classification"):
        missing = part.classification is None
        columns["classification"] = np.full(n, UNCLASSIFIED, np.uint8) if missing else _codes(part.classification)
    if found.has("time"):
        columns["time"] = np.asarray(part.time, np.float64)
    if found.has("intensity"):
        levels = np.zeros(n, np.uint16) if part.intensity is None else to_uint16(part.intensity, scan.low, scan.high)
        columns["intensity"] = levels
    return columns


def _to_uint8(rgb: Any, largest: float) -> U8:
    fraction = largest <= 1 and rgb.dtype.kind == "f"
    values = rgb.astype(np.float64)
    unknown = np.isnan(values).any(axis=1)
    values = np.nan_to_num(values) * (255 if fraction else 1 / 256 if largest > 255 else 1)
    levels = np.clip(np.rint(values) if fraction else np.floor(values), 0, 255).astype(np.uint8)
    levels[unknown] = UNCOLOURED
    return levels


def _codes(classification: Any) -> U8:
    """LAS codes (N,); other numbers are unclassified."""
    return np.where(_are_codes(classification), np.nan_to_num(classification), UNCLASSIFIED).astype(np.uint8)


def _are_codes(classification: Any) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (classification >= 0) & (classification <= 255) & (classification == np.rint(classification)), bool
        )


def all_withheld(path: Path, count: int) -> InputError:
    """Error for a file of which no point may be used."""
    remedy = "Clear the flag in the program that set it, or leave the file out"
    return InputError(path, f"all of its {count:,} points have the withheld flag (not to be used)", remedy)


def _checked(path: Path, found: Summary) -> Summary:
    if found.count:
        return found
    if found.withheld:
        raise all_withheld(path, found.withheld)
    raise InputError(path, "contains no points with finite coordinates", "Export it again, or leave it out")


def _extremes(values: npt.NDArray[Any]) -> tuple[float, float]:
    """Smallest and largest finite value; infinities if there is none."""
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (np.inf, -np.inf)
