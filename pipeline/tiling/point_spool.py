"""Points on their way to many tiles: one raw file a tile, so that no survey needs to fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I32, UNCOLOURED, Frame, PointCloud

QUANTUM = 0.001
"""CRS units, of coordinates; a whole number of them makes a unit, so that tiles with whole offsets agree on them."""
UNCLASSIFIED = 1
POINT = np.dtype(
    [
        ("place", "<i4", 3),
        ("rgb", "u1", 3),
        ("classification", "u1"),
        ("time", "<f8"),
        ("intensity", "<u2"),
        ("own", "?"),
    ]
)
CHUNK = 500_000


@dataclass
class Held:
    """What a tile has been given.

    Attributes:
        count: points.
        own: of them, those that are in no other tile's cell.
        low, high: (3,) bounds, in `QUANTUM` from the spool's base.
        some: attributes that a point has.
        lacking: attributes that a point lacks.
    """

    count: int = 0
    own: int = 0
    low: I32 = field(default_factory=lambda: np.full(3, np.iinfo(np.int32).max, np.int32))
    high: I32 = field(default_factory=lambda: np.full(3, np.iinfo(np.int32).min, np.int32))
    some: set[str] = field(default_factory=set)
    lacking: set[str] = field(default_factory=set)


class Spool:
    """Points of many tiles in raw files of a folder; a file is open only while it is written to."""

    def __init__(self, folder: Path, base: npt.ArrayLike, unit: float, tiles: int) -> None:
        """`base` (3,) are whole CRS units near all points, `unit` the metres of one."""
        self.folder, self.base, self.unit = folder, np.asarray(base, np.float64), unit
        self.held = [Held() for _ in range(tiles)]
        self.lost = 0  # points without a place: NaN

    def rows(self, cloud: PointCloud) -> npt.NDArray[Any]:
        """The finite points of a cloud as records, none of them any tile's own yet."""
        places = np.rint((cloud.frame.to_crs(cloud.xyz) - self.base) / QUANTUM)
        good = np.asarray((np.abs(places) < np.iinfo(np.int32).max).all(axis=1))  # NaN is none of them
        if not good.all():
            self.lost += int(np.count_nonzero(~good))
            cloud, places = cloud.take(good), places[good]
        rows = np.zeros(len(cloud), POINT)
        rows["place"] = places
        rows["rgb"] = UNCOLOURED if cloud.rgb is None else cloud.rgb
        rows["classification"] = UNCLASSIFIED if cloud.classification is None else cloud.classification
        for name in ("time", "intensity"):
            if (values := getattr(cloud, name)) is not None:
                rows[name] = values
        return rows

    def world(self, rows: npt.NDArray[Any]) -> F64:
        """(N, 3) world metres of records."""
        return (self.base + rows["place"] * QUANTUM) * self.unit

    def add(self, tile: int, rows: npt.NDArray[Any], source: PointCloud) -> None:
        """Give a tile records of points; `source` tells which attributes they have."""
        held = self.held[tile]
        held.count += len(rows)
        held.own += int(np.count_nonzero(rows["own"]))
        held.low = np.minimum(held.low, rows["place"].min(axis=0))
        held.high = np.maximum(held.high, rows["place"].max(axis=0))
        for name in ("rgb", "classification", "time", "intensity"):
            (held.lacking if getattr(source, name) is None else held.some).add(name)
        with open(self._file(tile), "ab") as file:
            rows.tofile(file)

    def bounds(self, tile: int) -> tuple[F64, F64]:
        """(3,) low and high corner of a tile's points, world metres."""
        held = self.held[tile]
        return (self.base + held.low * QUANTUM) * self.unit, (self.base + held.high * QUANTUM) * self.unit

    def sample(self, tile: int, most: int) -> F64:
        """(N, 3) at most so many of a tile's own points, drawn the same at every run, world metres."""
        rows: npt.NDArray[Any] = np.memmap(self._file(tile), POINT, "r")
        if len(rows) > most:
            rows = rows[np.unique(np.random.default_rng(0).integers(0, len(rows), most))]
        return self.world(rows[rows["own"]])

    def parts(self, tile: int, crs: str) -> Iterator[PointCloud]:
        """A tile's points in their order, a chunk at a time, in a frame in the middle of them.

        Colours are grey and classes "unclassified" where only some points have them; other attributes that not all
        of them have are left out (as by `PointCloud.join`).
        """
        held = self.held[tile]
        middle = np.floor(self.base + (held.low.astype(np.float64) + held.high) / 2 * QUANTUM)
        x, y, z = (middle * self.unit).tolist()
        frame = Frame(crs, (x, y, z), self.unit)
        kept = (held.some & {"rgb", "classification"}) | (held.some - held.lacking)
        with open(self._file(tile), "rb") as file:
            while len(rows := np.fromfile(file, POINT, CHUNK)):
                local = (rows["place"] * QUANTUM - (middle - self.base)) * self.unit
                columns = {name: rows[name].copy() for name in sorted(kept)}
                yield PointCloud(frame, local.astype(np.float32), **columns)

    def drop(self, tile: int) -> None:
        """Remove a tile's file."""
        self._file(tile).unlink(missing_ok=True)

    def _file(self, tile: int) -> Path:
        return self.folder / f"{tile}.points"
