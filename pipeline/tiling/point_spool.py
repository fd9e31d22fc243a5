"""Temporary storage of points while a survey is cut: one raw file per tile, so that memory is bounded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I32, UNCOLOURED, Frame, PointCloud

COORDINATE_STEP = 0.001
"""Resolution of coordinates, CRS units; it divides 1, so that tiles with integer offsets store equal coordinates."""
UNCLASSIFIED = 1
POINT_DTYPE = np.dtype(
    [
        ("xyz", "<i4", 3),
        ("rgb", "u1", 3),
        ("classification", "u1"),
        ("time", "<f8"),
        ("intensity", "<u2"),
        ("own", "?"),
    ]
)
CHUNK_POINTS = 500_000


@dataclass
class TilePoints:
    """Statistics of a tile's points.

    Attributes:
        count: number of points.
        own: number of points in the tile's own cell, without those in its buffer.
        low, high: (3,) bounds, in `COORDINATE_STEP` from the spool's base.
        present: attributes that at least one point has.
        missing: attributes that at least one point doesn't have.
    """

    count: int = 0
    own: int = 0
    low: I32 = field(default_factory=lambda: np.full(3, np.iinfo(np.int32).max, np.int32))
    high: I32 = field(default_factory=lambda: np.full(3, np.iinfo(np.int32).min, np.int32))
    present: set[str] = field(default_factory=set)
    missing: set[str] = field(default_factory=set)


class Spool:
    """Points of many tiles in raw files of a folder; a file is open only while it is written to."""

    def __init__(self, folder: Path, base: npt.ArrayLike, unit: float, tiles: int) -> None:
        """Create an empty spool; `base` (3,) is a position near all points in integer CRS units, `unit` metres each."""
        self.folder, self.base, self.unit = folder, np.asarray(base, np.float64), unit
        self.tiles = [TilePoints() for _ in range(tiles)]
        self.invalid = 0  # number of points with NaN coordinates

    def rows(self, cloud: PointCloud) -> npt.NDArray[Any]:
        """The finite points of a cloud as records, with `own` false."""
        steps = np.rint((cloud.frame.to_crs(cloud.xyz) - self.base) / COORDINATE_STEP)
        good = np.asarray((np.abs(steps) < np.iinfo(np.int32).max).all(axis=1))  # false for NaN
        if not good.all():
            self.invalid += int(np.count_nonzero(~good))
            cloud, steps = cloud.take(good), steps[good]
        rows = np.zeros(len(cloud), POINT_DTYPE)
        rows["xyz"] = steps
        rows["rgb"] = UNCOLOURED if cloud.rgb is None else cloud.rgb
        rows["classification"] = UNCLASSIFIED if cloud.classification is None else cloud.classification
        for name in ("time", "intensity"):
            if (values := getattr(cloud, name)) is not None:
                rows[name] = values
        return rows

    def world(self, rows: npt.NDArray[Any]) -> F64:
        """World coordinates (N, 3) of records, metres."""
        return (self.base + rows["xyz"] * COORDINATE_STEP) * self.unit

    def add(self, tile: int, rows: npt.NDArray[Any], source: PointCloud) -> None:
        """Append records to a tile; `source` is the cloud they are from, which determines their attributes."""
        points = self.tiles[tile]
        points.count += len(rows)
        points.own += int(np.count_nonzero(rows["own"]))
        points.low = np.minimum(points.low, rows["xyz"].min(axis=0))
        points.high = np.maximum(points.high, rows["xyz"].max(axis=0))
        for name in ("rgb", "classification", "time", "intensity"):
            (points.missing if getattr(source, name) is None else points.present).add(name)
        with open(self._file(tile), "ab") as file:
            rows.tofile(file)

    def bounds(self, tile: int) -> tuple[F64, F64]:
        """Low and high corner (3,) of a tile's points, world metres."""
        low, high = self.tiles[tile].low, self.tiles[tile].high
        return (self.base + low * COORDINATE_STEP) * self.unit, (self.base + high * COORDINATE_STEP) * self.unit

    def sample(self, tile: int, max_count: int) -> F64:
        """Deterministic random sample (N, 3) of at most `max_count` of a tile's own points, world metres."""
        rows: npt.NDArray[Any] = np.memmap(self._file(tile), POINT_DTYPE, "r")
        if len(rows) > max_count:
            rows = rows[np.unique(np.random.default_rng(0).integers(0, len(rows), max_count))]
        return self.world(rows[rows["own"]])

    def parts(self, tile: int, crs: str) -> Iterator[PointCloud]:
        """A tile's points in order, in chunks, in a frame with its origin in the middle of them.

        If only some points have colours, classes or intensities, the others are grey, unclassified or of intensity 0;
        times are omitted unless all points have them (as in step `ingest`).
        """
        points = self.tiles[tile]
        middle = np.floor(self.base + (points.low.astype(np.float64) + points.high) / 2 * COORDINATE_STEP)
        x, y, z = (middle * self.unit).tolist()
        frame = Frame(crs, (x, y, z), self.unit)
        kept = (points.present & {"rgb", "classification", "intensity"}) | (points.present - points.missing)
        with open(self._file(tile), "rb") as file:
            while len(rows := np.fromfile(file, POINT_DTYPE, CHUNK_POINTS)):
                local = (rows["xyz"] * COORDINATE_STEP - (middle - self.base)) * self.unit
                columns = {name: rows[name].copy() for name in sorted(kept)}
                yield PointCloud(frame, local.astype(np.float32), **columns)

    def drop(self, tile: int) -> None:
        """Remove a tile's file."""
        self._file(tile).unlink(missing_ok=True)

    def _file(self, tile: int) -> Path:
        return self.folder / f"{tile}.points"
