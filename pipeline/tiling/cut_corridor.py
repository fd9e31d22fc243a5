"""A corridor, too long for one tile, cut into the overlapping tiles of a survey (`scan2sim tile`).

Points stream: they are read a chunk at a time into a raw file for every tile (`pipeline.tiling.point_spool`), and each
of these becomes a `cloud.laz`. Memory depends neither on the survey's length nor on a tile's points.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import strangers
from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.parameters import Buffer, Length, Metres, Stretch
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F64, Tile, Trajectory
from scan2sim.pipeline.importers.tile_folder import place, tile_folder
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import orthophoto
from scan2sim.pipeline.io.survey import read_survey, write_survey
from scan2sim.pipeline.io.tile import TileFile, read_spec, read_tile, tile_name, write_tile
from scan2sim.pipeline.steps.ingest import MIN_POINTS
from scan2sim.pipeline.tiling.cut_plan import dense, members, seeds, sees
from scan2sim.pipeline.tiling.point_spool import QUANTUM, Spool
from scan2sim.pipeline.tiling.voronoi_cell import Cell, Seed, cells

VERSION = 1
"""Raised whenever the same corridor comes to other tiles with the same options."""
CHUNK = 500_000
"""Points that are read at a time."""
SAMPLE = 20_000
"""Points of a tile that are looked for in photos."""
NEAR = 3.0
"""Tiles whose seeds are further apart than so many lengths have no border."""
READING = 0.6
"""The share of the time that goes into reading, for the progress bar."""

Warn = Callable[[str], None]


class CutParams(Params):
    """How a corridor is cut."""

    length: Length = Field(100.0, description="Metres of road a tile.")
    buffer: Buffer = Field(5.0, description="Metres that tiles' clouds reach beyond their borders.")
    reach: Stretch = Field(60.0, description="Metres from the trajectory beyond which points are left out.")
    photo_reach: Metres = Field(40.0, description="Metres beyond a tile up to which photos are taken.")
    copy_photos: bool = Field(False, description="Copy photos into the tiles instead of naming them.")

    def check(self) -> None:
        """Raises a SettingError for what no corridor can be cut by."""
        if self.buffer > self.length / 2:
            raise SettingError(
                "buffer", f"{self.buffer:g} m is more than half a tile's length", "Give a smaller one, or longer tiles"
            )


@dataclass(frozen=True)
class Corridor:
    """What is cut.

    Attributes:
        tile: all of it.
        spec: what its `tile.toml` says; `spec.photos` are in the order of `tile.views`.
        low, high: (3,) corners of its clouds, CRS coordinates.
        counts: points of each cloud, as its header says.
        notes: what is wrong with the clouds' headers.
    """

    tile: Tile
    spec: TileFile
    low: F64
    high: F64
    counts: tuple[int, ...]
    notes: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path) -> Corridor:
        """Read a tile; one that was cut itself is refused."""
        tile = read_tile(path)
        spec = read_spec(tile.path)
        if spec.cell:
            raise InputError(tile.path, "was cut from a survey already", "Cut what it was cut from")
        tile = replace(tile, views=tile.views[: len(spec.photos)])  # the orthophoto is every tile's
        headers = [clouds.read_header(cloud) for cloud in tile.clouds]
        low, high = np.min([h.low for h in headers], axis=0), np.max([h.high for h in headers], axis=0)
        notes = tuple(f"{c.name}: {note}" for c, h in zip(tile.clouds, headers, strict=True) for note in h.notes)
        return cls(tile, spec, low, high, tuple(h.count for h in headers), notes)


def cut_survey(
    path: Path,
    out: Path,
    options: CutParams | None = None,
    *,
    name: str | None = None,
    overwrite: bool = False,
    report: Report = silent,
    warn: Warn = lambda _: None,
) -> Path:
    """Cut the corridor at `path` (a `tile.toml` or its folder) into tiles; returns the `survey.toml` in `out`.

    `out` gets a folder a tile, `NAME_0000` and on in order along the path, and appears whole or not at all. The same
    corridor and options write the same bytes.

    Args:
        path: the corridor.
        out: the survey's folder.
        options: how it is cut.
        name: of the survey; by default the corridor's.
        overwrite: replace a survey in `out`.
        report: receives progress.
        warn: receives what was left out, and what looks wrong.

    Raises:
        SettingError: an option out of range; `out` exists, or holds the corridor.
        InputError: a file of the corridor that is missing, damaged or wrong; it was cut from a survey already.
        DataError: too few points, or far too many tiles.
        SpaceError: the disk is full or may not be written to.
    """
    options = options or CutParams.model_validate({})
    options.check()
    corridor = Corridor.read(path)
    tile, spec = corridor.tile, corridor.spec
    name = tile_name(name or spec.name)
    final = (Path.cwd() / out).parent.resolve() / out.name
    if any(source.resolve().is_relative_to(final) for source in (tile.path, *tile.clouds)):
        raise SettingError(out, f"holds the corridor {tile.path}", "Name another folder")
    for note in corridor.notes:
        warn(note)
    missing = [view.photo for view in tile.views if not view.photo.is_file()]
    if missing:
        warn(
            f"{len(missing)} of {len(tile.views)} photos are missing, {missing[0]} first: tiles name them all the same"
        )
    with tile_folder(out, overwrite, "survey") as work:
        with TemporaryDirectory(prefix=".spool-", dir=work) as folder:
            places, spool = _spread(corridor, name, options, Path(folder), report, warn)
            pieces = cells(places, NEAR * options.length)
            writer = _Writer(corridor, spool, options, work, final)
            for i, key in enumerate(places):
                report(READING + (1 - READING) * i / len(places), f"writing {key}")
                writer.write(i, key, pieces[key])
        blind = [view.name for i, view in enumerate(tile.views) if i not in writer.given]
        if blind:
            warn(f"{len(blind)} of {len(tile.views)} photos see too little of any tile: {', '.join(blind[:5])}")
        write_survey(
            work,
            name=name,
            crs=tile.frame.crs,
            units=spec.units,
            length=float(options.length),
            buffer=float(options.buffer),
            tiles=list(places),
        )
        read_survey(work)  # what is written must be readable
    report(1.0, "done")
    return out / "survey.toml"


def _spread(
    corridor: Corridor, name: str, options: CutParams, folder: Path, report: Report, warn: Warn
) -> tuple[dict[str, Seed], Spool]:
    """Seeds, and the points of each tile; again without the seeds of tiles that get too few."""
    tile = corridor.tile
    unit = tile.frame.unit
    low, high = (corner[:2] * unit for corner in (corridor.low, corridor.high))
    places = seeds(name, tile.frame, options.length, low, high, tile.trajectory, warn)
    while True:
        spool = Spool(folder, np.floor(corridor.low), unit, len(places))
        far, strange = _assign(corridor, np.array(list(places.values())), options, spool, report)
        few = [i for i, held in enumerate(spool.held) if held.own < MIN_POINTS]
        if not few:
            break
        if len(few) == len(places):
            few.remove(max(few, key=lambda i: spool.held[i].own))  # it takes what the others had
        if not few:
            raise DataError(
                tile.path,
                f"only {spool.held[0].own:,} points, and {far:,} further than {options.reach:g} m from the trajectory",
                f"A tile needs {MIN_POINTS:,}; check that clouds and trajectory are in one CRS, or give a longer reach",
            )
        for i in range(len(places)):
            spool.drop(i)
        names = list(places)
        dropped = [names[i] for i in few]
        warn(
            f"{len(few)} of {len(names)} tiles have fewer than {MIN_POINTS:,} points and are not made "
            f"({', '.join(dropped[:5])}{' ...' if len(few) > 5 else ''}): their points go to the nearest ones"
        )
        places = {key: seed for key, seed in places.items() if key not in dropped}
    for warning in strange:
        warn(warning)
    if spool.lost:
        warn(f"{spool.lost:,} points with NaN coordinates left out")
    if far > sum(corridor.counts) / 2:
        warn(f"{far:,} of {sum(corridor.counts):,} points are further than {options.reach:g} m from the trajectory")
    return places, spool


def _assign(corridor: Corridor, places: F64, options: CutParams, spool: Spool, report: Report) -> tuple[int, list[str]]:
    """Give all points to their tiles; returns how many are out of the trajectory's reach, and what to say of codes."""
    from scipy.spatial import cKDTree

    tile = corridor.tile
    path = None
    if tile.trajectory is not None:
        path = cKDTree(dense((tile.trajectory.positions + np.asarray(tile.frame.origin))[:, :2]))
    total, done, far, strange = sum(corridor.counts), 0, 0, list[str]()
    for cloud in tile.clouds:
        table, count = clouds.meanings(cloud, tile.classes), np.zeros(256, np.int64)
        for part in clouds.chunks(cloud, tile.frame, CHUNK):
            report(READING * done / total, f"reading {cloud.name}")
            done += len(part)
            if part.classification is not None:
                count += np.bincount(part.classification, minlength=256)
                part = replace(part, classification=table[part.classification])
            rows = spool.rows(part)
            xy = spool.world(rows)[:, :2]
            if path is not None:
                near = np.isfinite(path.query(xy, distance_upper_bound=options.reach, workers=-1)[0])
                far += len(near) - int(np.count_nonzero(near))
                rows, xy = rows[near], xy[near]
            own, also, others = members(xy, places, options.buffer)
            points = np.concatenate([np.arange(len(xy)), also])
            tiles = np.concatenate([own, others])
            order = np.lexsort((points, tiles))  # in a tile they stay in the order of reading
            for some in np.split(order, np.flatnonzero(np.diff(tiles[order])) + 1):
                if len(some):
                    chosen = rows[points[some]]
                    chosen["own"] = some < len(xy)
                    spool.add(int(tiles[some[0]]), chosen, part)
        warning = strangers(count, table)
        strange += [f"{cloud.name}: {warning}"] if warning else []
    return far, strange


class _Writer:
    """Writes the tiles: clouds from the spool, and what of the rest of the corridor each needs."""

    def __init__(self, corridor: Corridor, spool: Spool, options: CutParams, work: Path, final: Path) -> None:
        """`work` becomes `final` once all is written; what tiles refer to is told from there."""
        self._corridor, self._spool, self._options, self._work, self._final = corridor, spool, options, work, final
        tile = corridor.tile
        self.given: set[int] = set()  # photos that a tile has got
        self._origin = np.asarray(tile.frame.origin)
        self._centres = np.array([view.centre + self._origin for view in tile.views]).reshape(-1, 3)

    def write(self, index: int, name: str, cell: Cell) -> None:
        """One tile: its cloud, trajectory, photos and `tile.toml`."""
        tile, spec, folder = self._corridor.tile, self._corridor.spec, self._work / name
        folder.mkdir()
        las.write_parts(folder / "cloud.laz", self._spool.parts(index, tile.frame.crs), QUANTUM * tile.frame.unit)
        part = self._trajectory(index)
        if part is not None:
            trajectory_io.write(folder / "trajectory.csv", part, tile.frame)
        photos = self._photos(index, cell)
        self.given.update(photos)
        used = {spec.photos[i].camera: tile.views[i].camera for i in photos}
        truth = {} if self._options.copy_photos else {"mesh": tile.truth_mesh, "points": tile.truth_points}
        write_tile(
            folder,
            name=name,
            crs=tile.frame.crs,
            units=spec.units,
            clouds=["cloud.laz"],
            cameras=used,
            photos=[self._photo(i, name) for i in photos],
            trajectory=None if part is None else "trajectory.csv",
            ortho=self._whole(spec.orthophoto, name),
            footprints=self._whole(spec.footprints, name),
            cell=self._cell(cell),
            truth={key: self._reference(path, name) for key, path in truth.items() if path},
        )
        self._spool.drop(index)

    def _whole(self, file: str | None, name: str) -> str | None:
        """What the tile of that name calls an orthophoto or footprints, which all tiles share."""
        if file is None:
            return None
        source = self._corridor.tile.path.parent / file
        return (
            orthophoto.take(source, self._work / name) if self._options.copy_photos else self._reference(source, name)
        )

    def _cell(self, cell: Cell) -> dict[str, Any]:
        """The `[cell]` entry; its seeds in the CRS are exactly those that the cells are made of."""

        def written(seed: Seed) -> list[float]:
            return [round(value / self._corridor.tile.frame.unit, 3) for value in seed]

        return {
            "seed": written(cell.seed),
            "buffer": float(self._options.buffer),
            "neighbours": {key: written(seed) for key, seed in cell.neighbours.items()},
        }

    def _trajectory(self, index: int) -> Trajectory | None:
        """The samples from which the scanner reached the tile's points."""
        path = self._corridor.tile.trajectory
        if path is None:
            return None
        low, high = (corner[:2] for corner in self._spool.bounds(index))
        xy, reach = (path.positions + self._origin)[:, :2], self._options.reach
        near = ((xy >= low - reach) & (xy <= high + reach)).all(axis=1)
        parts = {f.name: getattr(path, f.name) for f in fields(path)}
        return replace(path, **{k: v[near] for k, v in parts.items() if v is not None}) if near.any() else None

    def _photos(self, index: int, cell: Cell) -> list[int]:
        """Which photos see the tile's own part."""
        views = self._corridor.tile.views
        if not views:
            return []
        own = self._spool.sample(index, SAMPLE) - self._origin
        near = np.flatnonzero(cell.outside(self._centres[:, :2]) <= self._options.photo_reach)
        return [i for i in near.tolist() if sees(views[i], own)]

    def _photo(self, index: int, name: str) -> dict[str, Any]:
        """The `[[photos]]` entry in the tile of that name, its files copied if they shall be."""
        entry, view = self._corridor.spec.photos[index], self._corridor.tile.views[index]
        files = {"file": self._file(view.photo, name, "photos")}
        if view.mask is not None:
            files["mask"] = self._file(view.mask, name, "masks")
        return entry.model_dump() | files | {"name": view.name}

    def _file(self, source: Path, name: str, folder: str) -> str:
        """What the tile of that name calls a photo or mask."""
        if not self._options.copy_photos:
            return self._reference(source, name)
        within = os.path.relpath(source, self._corridor.tile.path.parent).replace(os.sep, "/")
        if not within.startswith(f"{folder}/"):
            within = f"{folder}/" + within.replace("../", "").lstrip("/")
        if source.is_file() and not (self._work / name / within).exists():  # many photos may share a mask
            place(source, self._work / name, within)
        return within

    def _reference(self, source: Path, name: str) -> str:
        """The path to a file of the corridor, or to what a link there leads to, from the folder of that tile."""
        return os.path.relpath(source.resolve(), self._final / name).replace(os.sep, "/")
