"""Cutting of a corridor that is too long for one tile into the overlapping tiles of a survey (`scan2sim tile`).

Points are streamed: chunks are read and appended to one raw file per tile (`pipeline.tiling.point_spool`), each of
which then becomes a `cloud.laz`. Memory depends neither on the survey's length nor on a tile's number of points.
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

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.parameters import MAX_NAME, Buffer, Length, Metres, Stretch
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F64, Tile, Trajectory
from scan2sim.pipeline.core.voronoi_cell import Cell, Seed, cells
from scan2sim.pipeline.geometry.path_sampling import resample_path
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.geodata import orthophoto
from scan2sim.pipeline.io.label_sets import codes_warning
from scan2sim.pipeline.io.survey import read_survey, write_survey
from scan2sim.pipeline.io.tile import MIN_POINTS, TileFile, read_spec, read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import add_file, tile_folder
from scan2sim.pipeline.tiling.cut_plan import seeds, sees, tile_membership
from scan2sim.pipeline.tiling.point_spool import COORDINATE_STEP, Spool

VERSION = 1
"""Version of the cut: raised when the same corridor and options give other tiles."""
CHUNK_POINTS = 500_000
"""Points that are read at a time."""
VISIBILITY_SAMPLE_POINTS = 20_000
"""Points of a tile that are projected into photos to select those that show it."""
MAX_NEIGHBOUR_LENGTHS = 3.0
"""Tiles whose seeds are farther apart than this many tile lengths are not neighbours."""
READING_PROGRESS = 0.6
"""Share of the progress bar for reading."""
NUMBER_WIDTH = 10
"""Characters of a tile's name that are left for its number."""

Warn = Callable[[str], None]


class CutParams(Params):
    """Settings for cutting a corridor."""

    length: Length = Field(100.0, description="Length of a tile: metres of path.")
    buffer: Buffer = Field(5.0, description="Metres by which tiles' clouds extend beyond their borders.")
    max_distance: Stretch = Field(60.0, description="Metres from the trajectory beyond which points are removed.")
    photo_distance: Metres = Field(40.0, description="Metres beyond a tile's border up to which photos are used.")
    copy_photos: bool = Field(False, description="Copy photos into the tiles instead of referring to them.")

    def check(self) -> None:
        """Raise a SettingError for inconsistent settings."""
        if self.buffer > self.length / 2:
            raise SettingError(
                "buffer",
                f"{self.buffer:g} m is more than half a tile's length",
                "Give a smaller buffer, or longer tiles",
            )


@dataclass(frozen=True)
class Corridor:
    """The corridor to be cut.

    Attributes:
        tile: the corridor as one tile.
        spec: content of its `tile.toml`; `spec.photos` are in the order of `tile.views`.
        low, high: (3,) corners of its clouds, CRS coordinates.
        counts: number of points of each cloud, from its header.
        notes: warnings about the clouds' headers.
    """

    tile: Tile
    spec: TileFile
    low: F64
    high: F64
    counts: tuple[int, ...]
    notes: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path) -> Corridor:
        """Read a tile; one that was itself cut from a survey is rejected."""
        tile = read_tile(path)
        spec = read_spec(tile.path)
        if spec.cell:
            raise InputError(tile.path, "was already cut from a survey", "Cut the original tile")
        tile = replace(tile, views=tile.views[: len(spec.photos)])  # without the orthophoto, which all tiles share
        headers = [clouds.read_header(cloud) for cloud in tile.clouds]
        low, high = np.min([h.low for h in headers], axis=0), np.max([h.high for h in headers], axis=0)
        notes = tuple(
            f"{cloud.name}: {note}"
            for cloud, header in zip(tile.clouds, headers, strict=True)
            for note in (*header.notes, crs_io.contradiction(header.crs, tile.frame.crs))
            if note
        )
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

    `out` gets one folder per tile, `NAME_0000` and so on in order along the path, and is created atomically. The same
    corridor and options give the same bytes.

    Args:
        path: the corridor.
        out: the survey's folder.
        options: settings.
        name: name of the survey; default: that of the corridor.
        overwrite: replace a survey in `out`.
        report: receives progress.
        warn: receives omissions and suspected errors.

    Raises:
        SettingError: a setting is out of range; `out` exists, or contains the corridor.
        InputError: a file of the corridor is missing, damaged or invalid; it was already cut from a survey.
        DataError: too few points, or far too many tiles.
        SpaceError: the disk is full or not writable.
    """
    options = options or CutParams.model_validate({})
    options.check()
    corridor = Corridor.read(path)
    tile, spec = corridor.tile, corridor.spec
    name = tile_name(name or spec.name)[: MAX_NAME - NUMBER_WIDTH]
    final = out.resolve()
    if any(source.resolve().is_relative_to(final) for source in (tile.path, *tile.clouds)):
        raise SettingError(out, f"contains the corridor {tile.path}", "Choose another folder")
    for note in corridor.notes:
        warn(note)
    missing = [view.photo for view in tile.views if not view.photo.is_file()]
    if missing:
        warn(
            f"{len(missing)} of {len(tile.views)} photos are missing, the first is {missing[0]}: "
            "the tiles refer to them nevertheless"
        )
    with tile_folder(out, overwrite, "survey") as work:
        with TemporaryDirectory(prefix=".spool-", dir=work) as folder:
            tile_seeds, spool = _distribute(corridor, name, options, Path(folder), report, warn)
            tile_cells = cells(tile_seeds, MAX_NEIGHBOUR_LENGTHS * options.length)
            writer = _Writer(corridor, spool, options, work, final)
            for i, key in enumerate(tile_seeds):
                report(READING_PROGRESS + (1 - READING_PROGRESS) * i / len(tile_seeds), f"writing {key}")
                writer.write(i, key, tile_cells[key])
        unused = [view.name for i, view in enumerate(tile.views) if i not in writer.used_photos]
        if unused:
            warn(f"{len(unused)} of {len(tile.views)} photos show too little of any tile: {', '.join(unused[:5])}")
        write_survey(
            work,
            name=name,
            crs=tile.frame.crs,
            units=spec.units,
            length=float(options.length),
            buffer=float(options.buffer),
            tiles=list(tile_seeds),
        )
        read_survey(work)  # check that the result is readable
    report(1.0, "done")
    return out / "survey.toml"


def _distribute(
    corridor: Corridor, name: str, options: CutParams, folder: Path, report: Report, warn: Warn
) -> tuple[dict[str, Seed], Spool]:
    """Place seeds and distribute points to tiles; repeated without the seeds of tiles with too few points."""
    tile = corridor.tile
    unit = tile.frame.unit
    low, high = (corner[:2] * unit for corner in (corridor.low, corridor.high))
    tile_seeds = seeds(name, tile.frame, options.length, low, high, tile.trajectory, warn)
    while True:
        spool = Spool(folder, np.floor(corridor.low), unit, len(tile_seeds))
        far, code_warnings = _assign(corridor, np.array(list(tile_seeds.values())), options, spool, report)
        too_few = [i for i, points in enumerate(spool.tiles) if points.own < MIN_POINTS]
        if not too_few:
            break
        if len(too_few) == len(tile_seeds):
            too_few.remove(max(too_few, key=lambda i: spool.tiles[i].own))  # the largest tile gets all points
        if not too_few:
            raise DataError(
                tile.path,
                f"only {spool.tiles[0].own:,} points, and {far:,} farther than {options.max_distance:g} m from the "
                "trajectory",
                f"A tile needs {MIN_POINTS:,}; check the CRS of clouds and trajectory, or increase --max-distance",
            )
        for i in range(len(tile_seeds)):
            spool.drop(i)
        names = list(tile_seeds)
        dropped = [names[i] for i in too_few]
        warn(
            f"{len(too_few)} of {len(names)} tiles have fewer than {MIN_POINTS:,} points and are skipped "
            f"({', '.join(dropped[:5])}{' ...' if len(too_few) > 5 else ''}): their points go to the nearest tiles"
        )
        tile_seeds = {key: seed for key, seed in tile_seeds.items() if key not in dropped}
    for warning in code_warnings:
        warn(warning)
    if spool.invalid:
        warn(f"{spool.invalid:,} points with NaN coordinates removed")
    if far > sum(corridor.counts) / 2:
        warn(
            f"{far:,} of {sum(corridor.counts):,} points are farther than {options.max_distance:g} m from "
            "the trajectory"
        )
    return tile_seeds, spool


def _assign(
    corridor: Corridor, seed_xy: F64, options: CutParams, spool: Spool, report: Report
) -> tuple[int, list[str]]:
    """Assign all points to tiles; returns the number of points too far from the trajectory, and warnings on points."""
    from scipy.spatial import cKDTree

    tile = corridor.tile
    path = None
    if tile.trajectory is not None:
        path = cKDTree(resample_path((tile.trajectory.positions + np.asarray(tile.frame.origin))[:, :2]))
    total, done, far, warnings = sum(corridor.counts), 0, 0, list[str]()
    for cloud, declared in zip(tile.clouds, corridor.counts, strict=True):
        before = done
        table, count = clouds.code_table(cloud, tile.classes), np.zeros(256, np.int64)
        for part in clouds.chunks(cloud, tile.frame, CHUNK_POINTS):
            report(READING_PROGRESS * done / total, f"reading {cloud.name}")
            done += len(part)
            if part.classification is not None:
                count += np.bincount(part.classification, minlength=256)
                part = replace(part, classification=table[part.classification])
            rows = spool.rows(part)
            xy = spool.world(rows)[:, :2]
            if path is not None:
                near = np.isfinite(path.query(xy, distance_upper_bound=options.max_distance, workers=-1)[0])
                far += len(near) - int(np.count_nonzero(near))
                rows, xy = rows[near], xy[near]
            own, buffer_points, buffer_tiles = tile_membership(xy, seed_xy, options.buffer)
            points = np.concatenate([np.arange(len(xy)), buffer_points])
            tiles = np.concatenate([own, buffer_tiles])
            order = np.lexsort((points, tiles))  # points of a tile keep their order
            for in_tile in np.split(order, np.flatnonzero(np.diff(tiles[order])) + 1):
                if len(in_tile):
                    chosen = rows[points[in_tile]]
                    chosen["own"] = in_tile < len(xy)
                    spool.add(int(tiles[in_tile[0]]), chosen, part)
        notes = codes_warning(count, table), clouds.left_out(declared, done - before)
        warnings += [f"{cloud.name}: {note}" for note in notes if note]
    return far, warnings


class _Writer:
    """Writes the tiles: clouds from the spool, and each tile's part of the trajectory and photos."""

    def __init__(self, corridor: Corridor, spool: Spool, options: CutParams, work: Path, final: Path) -> None:
        """Create a writer into `work`, which is renamed to `final` at the end; references are relative to `final`."""
        self._corridor, self._spool, self._options, self._work, self._final = corridor, spool, options, work, final
        tile = corridor.tile
        self.used_photos: set[int] = set()  # indices of photos that a tile uses
        self._origin = np.asarray(tile.frame.origin)
        self._centres = np.array([view.centre + self._origin for view in tile.views]).reshape(-1, 3)

    def write(self, index: int, name: str, cell: Cell) -> None:
        """Write one tile: its cloud, trajectory, photos and `tile.toml`."""
        tile, spec, folder = self._corridor.tile, self._corridor.spec, self._work / name
        folder.mkdir()
        las.write_parts(
            folder / "cloud.laz", self._spool.parts(index, tile.frame.crs), COORDINATE_STEP * tile.frame.unit
        )
        part = self._trajectory(index)
        if part is not None:
            trajectory_io.write(folder / "trajectory.csv", part, tile.frame)
        photos = self._photos(index, cell)
        self.used_photos.update(photos)
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
            ortho=self._shared_file(spec.orthophoto, name),
            footprints=self._shared_file(spec.footprints, name),
            cell=self._cell(cell),
            truth={key: self._reference(path, name) for key, path in truth.items() if path},
        )
        self._spool.drop(index)

    def _shared_file(self, file: str | None, name: str) -> str | None:
        """Path of the orthophoto or footprints, which all tiles share, in the tile `name`; copied if photos are."""
        if file is None:
            return None
        source = self._corridor.tile.path.parent / file
        return (
            orthophoto.copy_to_tile(source, self._work / name)
            if self._options.copy_photos
            else self._reference(source, name)
        )

    def _cell(self, cell: Cell) -> dict[str, Any]:
        """The `[cell]` entry; its rounded seeds are exactly those from which the cells were computed."""

        def in_crs(seed: Seed) -> list[float]:
            return [round(value / self._corridor.tile.frame.unit, 3) for value in seed]

        return {
            "seed": in_crs(cell.seed),
            "buffer": float(self._options.buffer),
            "neighbours": {key: in_crs(seed) for key, seed in cell.neighbours.items()},
        }

    def _trajectory(self, index: int) -> Trajectory | None:
        """The poses from which the scanner could measure the tile's points."""
        path = self._corridor.tile.trajectory
        if path is None:
            return None
        low, high = (corner[:2] for corner in self._spool.bounds(index))
        xy, reach = (path.positions + self._origin)[:, :2], self._options.max_distance
        near = ((xy >= low - reach) & (xy <= high + reach)).all(axis=1)
        parts = {f.name: getattr(path, f.name) for f in fields(path)}
        return replace(path, **{k: v[near] for k, v in parts.items() if v is not None}) if near.any() else None

    def _photos(self, index: int, cell: Cell) -> list[int]:
        """Indices of the photos that show the tile's own points."""
        views = self._corridor.tile.views
        if not views:
            return []
        own = self._spool.sample(index, VISIBILITY_SAMPLE_POINTS) - self._origin
        near = np.flatnonzero(cell.outside(self._centres[:, :2]) <= self._options.photo_distance)
        return [i for i in near.tolist() if sees(views[i], own)]

    def _photo(self, index: int, name: str) -> dict[str, Any]:
        """The `[[photos]]` entry of a photo in the tile `name`; copies its files if requested."""
        entry, view = self._corridor.spec.photos[index], self._corridor.tile.views[index]
        files = {"file": self._file(view.photo, name, "photos")}
        if view.mask is not None:
            files["mask"] = self._file(view.mask, name, "masks")
        return entry.model_dump() | files | {"name": view.name}

    def _file(self, source: Path, name: str, folder: str) -> str:
        """Path of a photo or mask in the tile `name`; copies it if requested."""
        if not self._options.copy_photos:
            return self._reference(source, name)
        within = os.path.relpath(source, self._corridor.tile.path.parent).replace(os.sep, "/")
        if not within.startswith(f"{folder}/"):
            within = f"{folder}/" + within.replace("../", "").lstrip("/")
        if source.is_file() and not (self._work / name / within).exists():  # photos may share a mask
            add_file(source, self._work / name, within)
        return within

    def _reference(self, source: Path, name: str) -> str:
        """Relative path from the folder of the tile `name` to a file of the corridor, with links resolved."""
        return os.path.relpath(source.resolve(), self._final / name).replace(os.sep, "/")
