"""The world of a survey: all its tiles' worlds in one, each in a level that a simulator loads by itself.

Tiles keep their models as they are; where each is comes from its pose. Meshes and textures are hard links, so the
survey's world takes hardly any room.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError, from_os_error
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import opendrive
from scan2sim.pipeline.io.worlds import scene, sdf

EDITED = (".sdf", ".config", ".json", ".mtl", ".geojson", ".csv", ".xodr")
"""Suffixes of what users change by hand: copied, never linked."""
STAMP, ROADS_STAMP = ".result", ".roads"
VERSION = 4
"""Of what is written: another one makes worlds anew."""


@dataclass(frozen=True)
class TileWorld:
    """A tile's exported world.

    Attributes:
        name: of the tile and its model; unique in a survey.
        world: folder that `pipeline.steps.export` wrote, with `metadata.json` and `models/<name>/`.
        frame: of the tile.
    """

    name: str
    world: Path
    frame: Frame

    @property
    def model(self) -> Path:
        """Folder of the tile's model."""
        return self.world / "models" / self.name

    @property
    def files(self) -> list[Path]:
        """All files of the tile that go into the survey's world, relative to both worlds."""
        folders = (self.model, self.world / scene.FOLDER / self.name)
        return sorted(p.relative_to(self.world) for folder in folders for p in folder.rglob("*") if p.is_file())


def assemble(
    out: Path,
    name: str,
    tiles: Sequence[TileWorld],
    *,
    buffer: float = sdf.BUFFER,
    performer: str = sdf.PERFORMER,
    warn: Callable[[str], None] = lambda _: None,
) -> Path:
    """Put the worlds of all tiles into one, `out/world/`, unless it is there and nothing has changed.

    Layout: `<name>.sdf`, `metadata.json`, `models/<tile>/` of every tile, and `scene/`, to export from. The world's
    origin is that of the tile in the middle. An earlier world stays until the new one is complete.

    Args:
        name: of the world.
        buffer: metres around a tile within which a performer has it loaded.
        performer: name of the robot's model, which levels are loaded for.
        warn: told of files that were changed since the world was made, by hand or by damage.

    Returns:
        Path of the world's .sdf.

    Raises:
        InputError: a tile's world is incomplete or in another CRS than the first's, or two have one name.
        DataError: there is no tile.
        SpaceError: the disk is full or can't be written to.
    """
    if not tiles:
        raise DataError(name, "no tile of the survey has a world", "See in its report why they failed")
    _check(tiles)
    files = {tile.name: tile.files for tile in tiles}
    world = out / "world"
    stamp = _stamp(name, tiles, files, buffer, performer)
    if not _is_current(world, stamp, tiles, files):
        fresh = out / ".world"
        try:
            shutil.rmtree(fresh, ignore_errors=True)
            _write(fresh, name, tiles, buffer, performer)
            (fresh / STAMP).write_text(stamp, encoding="utf-8")
            swap(fresh, world)
        except OSError as error:
            raise from_os_error(error, out) from None
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    else:
        for path in _edited(world):
            warn(f"{path} was changed since it was made, and stays so: remove {world} to have it made anew")
    return world / f"{name}.sdf"


def add_roads(out: Path) -> None:
    """Write all tiles' roads as one into the world in `out`, once: `<name>.xodr` and `<name>_roads.geojson`.

    Without lanes neither is written.

    Raises:
        InputError: the world is incomplete.
        SpaceError: the disk is full or can't be written to.
    """
    world = out / "world"
    if (world / ROADS_STAMP).is_file():
        return
    try:
        opendrive.write_roads(scene.read_scene(world), world)
        (world / ROADS_STAMP).touch()
        os.utime(world / STAMP)  # so that the roads don't count as users' edits
    except OSError as error:
        raise from_os_error(error, world) from None


def link(source: str, target: str) -> None:
    """A hard link where that can be, else a copy; a copy of what users edit, so that no edit reaches the source."""
    try:
        if Path(source).suffix in EDITED:
            raise OSError("users edit this")
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def same_file(source: Path, copy: Path) -> bool:
    """Whether a file is `link`'s of the source, and neither has been changed since."""
    try:
        a, b = source.stat(), copy.stat()
    except OSError:
        return False
    return os.path.samestat(a, b) or (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)


def same_unless_edited(source: Path, copy: Path) -> bool:
    """`same_file`, but of what users edit only whether it is there."""
    return copy.is_file() if copy.suffix in EDITED else same_file(source, copy)


def swap(fresh: Path, place: Path) -> None:
    """Move a finished folder to its place; the one that is there goes only then."""
    earlier = place.with_name(f".{place.name}-earlier")
    shutil.rmtree(earlier, ignore_errors=True)
    if place.exists():
        place.rename(earlier)
    fresh.rename(place)
    shutil.rmtree(earlier, ignore_errors=True)


def _check(tiles: Sequence[TileWorld]) -> None:
    first = tiles[0]
    names = set[str]()
    for tile in tiles:
        for file in (tile.world / "metadata.json", tile.model / "model.sdf", tile.world / scene.FOLDER / scene.ABOUT):
            if not file.is_file():
                raise InputError(file, "is missing", 'Make the tile\'s world again, with "gazebo" in export.formats')
        if tile.name in names:
            raise InputError(tile.world, f"is a second tile of the name {tile.name}", "Give each tile its own name")
        if not _same_system(tile.frame, first.frame):
            raise InputError(
                tile.world,
                f"is in {crs.name(tile.frame.crs)} ({tile.frame.unit:g} m a unit), but {first.name} is in "
                f"{crs.name(first.frame.crs)} ({first.frame.unit:g} m a unit)",
                "Bring all tiles of a survey to one CRS first",
            )
        names.add(tile.name)


def _same_system(a: Frame, b: Frame) -> bool:
    """Whether two frames are in one CRS, be it written as a code or as WKT."""
    if (a.crs, a.unit) == (b.crs, b.unit):
        return True
    name = crs.name(a.crs)
    return a.unit == b.unit and name.startswith("EPSG:") and name == crs.name(b.crs)


def _stamp(name: str, tiles: Sequence[TileWorld], files: dict[str, list[Path]], buffer: float, performer: str) -> str:
    """A digest of everything the world is made from; of files, their sizes and times of change."""
    parts: list[Any] = [VERSION, name, buffer, performer]
    for tile in tiles:
        paths = [tile.world / "metadata.json", *(tile.world / file for file in files[tile.name])]
        stats = [(path.relative_to(tile.world).as_posix(), path.stat()) for path in paths]
        parts += [tile.name, asdict(tile.frame), [(path, s.st_size, s.st_mtime_ns) for path, s in stats]]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _is_current(world: Path, stamp: str, tiles: Sequence[TileWorld], files: dict[str, list[Path]]) -> bool:
    """Whether the world was made of these tiles, and its meshes and textures are theirs."""
    try:
        same = (world / STAMP).read_text(errors="replace", encoding="utf-8") == stamp
    except OSError:
        return False
    pairs = [(tile.world / file, world / file) for tile in tiles for file in files[tile.name]]
    return same and all(same_unless_edited(file, copy) for file, copy in pairs)


def _edited(world: Path) -> list[Path]:
    """Files that were written to after the world was finished: users' edits, or damage; nobody can tell which."""
    finished = (world / STAMP).stat().st_mtime_ns
    return [p for p in sorted(world.rglob("*")) if p.suffix in EDITED and p.stat().st_mtime_ns > finished]


def _write(folder: Path, name: str, tiles: Sequence[TileWorld], buffer: float, performer: str) -> None:
    origin = _origin(tiles)
    first = tiles[0].frame
    place = sdf.Georeference.of(Frame(first.crs, origin, first.unit))
    metadata = {tile.name: _metadata(tile.world / "metadata.json") for tile in tiles}
    placed = [_place(tile, metadata[tile.name], origin) for tile in tiles]
    for tile in tiles:
        for kept in (Path("models") / tile.name, Path(scene.FOLDER) / tile.name):
            shutil.copytree(tile.world / kept, folder / kept, copy_function=link)
    scene.describe(folder, name, Frame(first.crs, origin, first.unit), [tile.name for tile in tiles])
    sdf.write_levels(folder / f"{name}.sdf", name, place, placed, buffer, performer)
    about = {
        "name": name,
        "crs": first.crs,
        "unit_m": first.unit,
        "to_crs": "crs = (world + world_origin_m) / unit_m; world = local + offset_m, local as in a tile's meshes",
        "world_origin_m": list(origin),
        "wgs84": place and place.facts(),
        "buffer_m": buffer,
        "performer": performer,
        "tiles": {
            tile.name: {
                "origin_m": list(tile.frame.origin),
                "offset_m": list(model.offset),
                "low_m": list(model.low),
                "high_m": list(model.high),
            }
            for tile, model in zip(tiles, placed, strict=True)
        },
        "triangles_by_file": {file: n for one in metadata.values() for file, n in _of_models(one).items()},
    }
    (folder / "metadata.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def _metadata(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise InputError(path, f"is not valid JSON ({error})", "Mend it, or make the tile's world again") from None


def _of_models(metadata: dict[str, Any]) -> dict[str, int]:
    """Triangles of the mesh files of a tile's model: the others stay with the tile."""
    return {file: n for file, n in metadata["triangles_by_file"].items() if file.startswith("models/")}


def _origin(tiles: Sequence[TileWorld]) -> sdf.Vector:
    """Origin, in whole metres, of the tile that is nearest to the middle of all: coordinates stay small."""
    origins = np.array([tile.frame.origin for tile in tiles])
    middle = (origins.min(axis=0) + origins.max(axis=0)) / 2
    x, y, z = np.round(origins[np.argmin(np.linalg.norm(origins - middle, axis=1))]).tolist()
    return x, y, z


def _place(tile: TileWorld, metadata: dict[str, Any], origin: sdf.Vector) -> sdf.Placed:
    """Where a tile's model is in the world, and the box around all its groups."""
    groups = metadata["groups"].values()
    low = np.min([group["low_m"] for group in groups], axis=0).tolist()
    high = np.max([group["high_m"] for group in groups], axis=0).tolist()
    offset = np.subtract(tile.frame.origin, origin).tolist()
    return sdf.Placed(tile.name, tuple(offset), tuple(low), tuple(high))
