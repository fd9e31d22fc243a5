"""Chunked reading of point clouds, shared by all readers but LAS's.

A reader yields `Points`: CRS coordinates in float64, colours and intensities in the file's own range. This module
turns them into `PointCloud`s: 8-bit colours and 16-bit intensities, scaled by one factor for the whole file; points
without finite coordinates (PCD and E57 mark beams without an echo that way) are removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud

READ_POINTS = 500_000
"""Points that readers hold in memory at a time."""


@dataclass(frozen=True)
class Points:
    """A chunk of a file's points.

    Attributes:
        xyz: (N, 3) float64, CRS coordinates.
        rgb: (N, 3) values in 0..1, 0..255 or 0..65535, or None.
        classification: (N,) LAS codes, or None.
        time: (N,) seconds, or None.
        intensity: (N,) values in 0..1, 0..255 or 0..65535, or None.
    """

    xyz: F64
    rgb: npt.NDArray[Any] | None = None
    classification: npt.NDArray[Any] | None = None
    time: npt.NDArray[Any] | None = None
    intensity: npt.NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, index: npt.NDArray[Any] | slice) -> Points:
        """The points selected by `index` (mask, integers or slice)."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return Points(**{key: value[index] for key, value in parts.items() if value is not None})


@dataclass(frozen=True)
class Summary:
    """Statistics of a file: number of finite points, bounds (CRS units), largest colour value and intensity."""

    count: int
    low: F64
    high: F64
    rgb: float
    intensity: float


def summary(path: Path, parts: Iterable[Points]) -> Summary:
    """Statistics over all chunks of a file.

    Raises:
        InputError: no point has finite coordinates.
    """
    count, low, high, rgb, intensity = 0, np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0
    for part in map(_finite, parts):
        if len(part):
            count += len(part)
            low, high = np.minimum(low, part.xyz.min(axis=0)), np.maximum(high, part.xyz.max(axis=0))
            rgb, intensity = max(rgb, _largest(part.rgb)), max(intensity, _largest(part.intensity))
    if count == 0:
        raise InputError(path, "contains no points with finite coordinates", "Export it again, or leave it out")
    return Summary(count, low, high, rgb, intensity)


def read_all(path: Path, parts: Iterable[Points], frame: Frame) -> PointCloud:
    """All points in `frame`'s local coordinates.

    Raises:
        InputError: no point has finite coordinates, or a class is not a LAS code.
    """
    kept, rgb, intensity = list[Points](), 0.0, 0.0
    for part in map(_finite, parts):
        rgb, intensity = max(rgb, _largest(part.rgb)), max(intensity, _largest(part.intensity))
        kept.append(replace(part, xyz=frame.to_local(part.xyz).astype(np.float32)))  # half the memory
    if not sum(map(len, kept)):
        raise InputError(path, "contains no points with finite coordinates", "Export it again, or leave it out")

    def column(name: str) -> Any:
        values = [getattr(part, name) for part in kept]
        return None if any(value is None for value in values) else np.concatenate(values)

    return PointCloud(
        frame,
        column("xyz"),
        _to_uint8(column("rgb"), rgb),
        classification=_codes(path, column("classification")),
        time=_times(column("time")),
        intensity=to_uint16(column("intensity"), intensity),
    )


def read_chunks(path: Path, parts: Iterable[Points], found: Summary, frame: Frame, size: int) -> Iterator[PointCloud]:
    """The points in file order, at most `size` per chunk, each chunk in a frame with its origin near its points."""
    for part in map(_finite, parts):
        for at in range(0, len(part), size):
            chunk = part.take(slice(at, at + size))
            x, y, z = np.floor(chunk.xyz.mean(axis=0) * frame.unit).tolist()
            near = replace(frame, origin=(x, y, z))
            yield PointCloud(
                near,
                near.to_local(chunk.xyz).astype(np.float32),
                _to_uint8(chunk.rgb, found.rgb),
                classification=_codes(path, chunk.classification),
                time=_times(chunk.time),
                intensity=to_uint16(chunk.intensity, found.intensity),
            )


def to_uint16(levels: npt.NDArray[Any] | None, largest: float) -> Any:
    """Scale intensities to 0..65535 by the file's largest value: 1 or less, 255 or less, or larger."""
    if levels is None or not largest > 0:
        return None
    factor = 65535 if largest <= 1 else 257 if largest <= 255 else 1
    return np.clip(np.rint(np.nan_to_num(levels.astype(np.float64)) * factor), 0, 65535).astype(np.uint16)


def _to_uint8(rgb: npt.NDArray[Any] | None, largest: float) -> Any:
    if rgb is None or not largest > 0:  # colour fields that were never filled
        return None
    fraction = largest <= 1 and rgb.dtype.kind == "f"
    values = np.nan_to_num(rgb.astype(np.float64)) * (255 if fraction else 1 / 256 if largest > 255 else 1)
    return np.clip(np.rint(values) if fraction else np.floor(values), 0, 255).astype(np.uint8)


def _codes(path: Path, classification: npt.NDArray[Any] | None) -> Any:
    if classification is None:
        return None
    codes = np.nan_to_num(classification, nan=-1)
    wrong = (codes < 0) | (codes > 255) | (codes != np.rint(codes))
    if wrong.any():
        cause = f"contains class {codes[wrong][0]:g}, which is not a LAS code (0 to 255)"
        raise InputError(path, cause, "Map it to one")
    return codes.astype(np.uint8)


def _times(time: npt.NDArray[Any] | None) -> Any:
    return None if time is None or not time.any() else time.astype(np.float64)


def _finite(part: Points) -> Points:
    good = np.asarray(np.isfinite(part.xyz).all(axis=1))
    return part if good.all() else part.take(good)


def _largest(values: npt.NDArray[Any] | None) -> float:
    return 0.0 if values is None else float(np.nan_to_num(values).max(initial=0))
