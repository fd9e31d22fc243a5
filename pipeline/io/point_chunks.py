"""Points as files have them, part by part: what all readers but LAS's share.

A reader yields `Points`: CRS coordinates in float64, colours and intensities in whatever range the file has. Here they
become `PointCloud`s: colours of 8 bits, intensities of 16, both by one rule for the whole file, points without
finite coordinates (how PCD and E57 mark a beam that met nothing) left out.
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

PART = 500_000
"""Points that readers hold at a time."""


@dataclass(frozen=True)
class Points:
    """Some points of a file.

    Attributes:
        xyz: (N, 3) float64, CRS coordinates.
        rgb: (N, 3) numbers, in 0 to 1, to 255, or to 65535, or None.
        classification: (N,) LAS codes, or None.
        time: (N,) seconds, or None.
        intensity: (N,) numbers, in 0 to 1, to 255, or to 65535, or None.
    """

    xyz: F64
    rgb: npt.NDArray[Any] | None = None
    classification: npt.NDArray[Any] | None = None
    time: npt.NDArray[Any] | None = None
    intensity: npt.NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, index: npt.NDArray[Any] | slice) -> Points:
        """The points that `index` (mask, integers or slice) selects."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return Points(**{key: value[index] for key, value in parts.items() if value is not None})


@dataclass(frozen=True)
class Summary:
    """What all points of a file say together: how many are finite, their bounds (CRS units), the largest values."""

    count: int
    low: F64
    high: F64
    rgb: float
    intensity: float


def summary(path: Path, parts: Iterable[Points]) -> Summary:
    """Of all parts of a file.

    Raises:
        InputError: no point has finite coordinates.
    """
    count, low, high, rgb, intensity = 0, np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0
    for part in map(_finite, parts):
        if len(part):
            count += len(part)
            low, high = np.minimum(low, part.xyz.min(axis=0)), np.maximum(high, part.xyz.max(axis=0))
            rgb, intensity = max(rgb, _top(part.rgb)), max(intensity, _top(part.intensity))
    if count == 0:
        raise InputError(path, "holds no points with finite coordinates", "Export it again, or leave it out")
    return Summary(count, low, high, rgb, intensity)


def whole(path: Path, parts: Iterable[Points], frame: Frame) -> PointCloud:
    """All points in `frame`'s local coordinates.

    Raises:
        InputError: no point has finite coordinates, or a class is no LAS code.
    """
    kept, rgb, intensity = list[Points](), 0.0, 0.0
    for part in map(_finite, parts):
        rgb, intensity = max(rgb, _top(part.rgb)), max(intensity, _top(part.intensity))
        kept.append(replace(part, xyz=frame.to_local(part.xyz).astype(np.float32)))  # half the memory
    if not sum(map(len, kept)):
        raise InputError(path, "holds no points with finite coordinates", "Export it again, or leave it out")

    def column(name: str) -> Any:
        values = [getattr(part, name) for part in kept]
        return None if any(value is None for value in values) else np.concatenate(values)

    return PointCloud(
        frame,
        column("xyz"),
        _eight_bits(column("rgb"), rgb),
        classification=_codes(path, column("classification")),
        time=_times(column("time")),
        intensity=sixteen_bits(column("intensity"), intensity),
    )


def local(path: Path, parts: Iterable[Points], found: Summary, frame: Frame, size: int) -> Iterator[PointCloud]:
    """The points in their order, `size` at a time at most, each part in a frame with its origin near its points."""
    for part in map(_finite, parts):
        for at in range(0, len(part), size):
            some = part.take(slice(at, at + size))
            x, y, z = np.floor(some.xyz.mean(axis=0) * frame.unit).tolist()
            near = replace(frame, origin=(x, y, z))
            yield PointCloud(
                near,
                near.to_local(some.xyz).astype(np.float32),
                _eight_bits(some.rgb, found.rgb),
                classification=_codes(path, some.classification),
                time=_times(some.time),
                intensity=sixteen_bits(some.intensity, found.intensity),
            )


def sixteen_bits(levels: npt.NDArray[Any] | None, top: float) -> Any:
    """Intensities to 0..65535, of a file whose largest is `top`: 1 or less, 255 or less, or larger."""
    if levels is None or not top > 0:
        return None
    factor = 65535 if top <= 1 else 257 if top <= 255 else 1
    return np.clip(np.rint(np.nan_to_num(levels.astype(np.float64)) * factor), 0, 65535).astype(np.uint16)


def _eight_bits(rgb: npt.NDArray[Any] | None, top: float) -> Any:
    if rgb is None or not top > 0:  # fields that were never filled
        return None
    fraction = top <= 1 and rgb.dtype.kind == "f"
    values = np.nan_to_num(rgb.astype(np.float64)) * (255 if fraction else 1 / 256 if top > 255 else 1)
    return np.clip(np.rint(values) if fraction else np.floor(values), 0, 255).astype(np.uint8)


def _codes(path: Path, classification: npt.NDArray[Any] | None) -> Any:
    if classification is None:
        return None
    codes = np.nan_to_num(classification, nan=-1)
    wrong = (codes < 0) | (codes > 255) | (codes != np.rint(codes))
    if wrong.any():
        raise InputError(path, f"has the class {codes[wrong][0]:g}, which is no LAS code (0 to 255)", "Map it to one")
    return codes.astype(np.uint8)


def _times(time: npt.NDArray[Any] | None) -> Any:
    return None if time is None or not time.any() else time.astype(np.float64)


def _finite(part: Points) -> Points:
    good = np.asarray(np.isfinite(part.xyz).all(axis=1))
    return part if good.all() else part.take(good)


def _top(values: npt.NDArray[Any] | None) -> float:
    return 0.0 if values is None else float(np.nan_to_num(values).max(initial=0))
