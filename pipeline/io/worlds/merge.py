"""The world of a survey: the worlds of all its tiles combined, each in a level that the simulator loads separately.

The models of tiles are unchanged; the world places them by their poses. Meshes and textures are hard links, so that
the survey's world takes hardly any disk space.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError, ScanError, from_os_error
from scan2sim.pipeline.core.paths import new_folder
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import copy_tree, copy_with_time
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import SceneParams, gazebo, opendrive, optional_part
from scan2sim.pipeline.io.worlds import readme, scene, sdf
from scan2sim.pipeline.io.worlds.spawn import default_pose

USER_EDITABLE_SUFFIXES = (
    ".sdf", ".world", ".config", ".json", ".mtl", ".geojson", ".csv", ".xodr", ".yaml", ".py", ".md",
)  # fmt: skip
"""Suffixes of files that users edit by hand: copied, never linked."""
STAMP_FILE, ROADS_STAMP_FILE, DOME_STAMP_FILE = ".result", ".roads", ".dome"
VERSION = 7
"""Version of the layout: when it changes, worlds are rebuilt."""


MakeDome = Callable[[scene.Scene, Path], None]


@dataclass(frozen=True)
class TileWorld:
    """A tile's exported world.

    Attributes:
        name: name of the tile and its model; unique in a survey.
        world: folder that `pipeline.steps.export` wrote, with `metadata.json` and `models/<name>/`.
        frame: frame of the tile.
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
        """All files of the tile that the survey's world contains, relative to either world."""
        folders = (self.model, self.world / scene.SCENE_FOLDER / self.name)
        return sorted(p.relative_to(self.world) for folder in folders for p in folder.rglob("*") if p.is_file())


def assemble(
    out: Path,
    name: str,
    tiles: Sequence[TileWorld],
    *,
    buffer: float = sdf.LEVEL_BUFFER_M,
    performer: str = sdf.PERFORMER_NAME,
    dome: MakeDome = lambda scene, folder: None,
    warn: Callable[[str], None] = lambda _: None,
    failed: dict[str, ScanError] | None = None,
) -> Path:
    """Combine the worlds of all tiles into `out/world/`, unless it exists and nothing has changed.

    Layout: `<name>.sdf`, `metadata.json`, `models/<tile>/` of every tile, and `scene/`, to export from. The world's
    origin is that of the tile in the middle. An earlier world is replaced once the new one is complete.

    Args:
        out: output folder of the survey.
        name: name of the world.
        tiles: worlds of the tiles.
        buffer: distance (m) from a tile at which a performer loads it.
        performer: name of the robot's model, for which levels are loaded.
        dome: writes the sky dome of all tiles, as of `scene.add_dome`; the same for the same tiles.
        warn: receives a warning for each file that has changed since the world was written, by hand or by damage.
        failed: receives the errors of optional parts by name: "sky_dome", "spawn", "traffic", "readme"; the world is
            written without them, and written again by the next call. None: their errors are raised.

    Returns:
        Path of the world's .sdf.

    Raises:
        InputError: a tile's world is incomplete or its CRS differs from the first's, or two tiles have the same name.
        DataError: there is no tile.
        SpaceError: the disk is full or not writable.
    """
    if not tiles:
        raise DataError(name, "no tile of the survey has a world", "The survey's report says why they failed")
    _check(tiles)
    files = {tile.name: tile.files for tile in tiles}
    world = out / "world"
    stamp = _stamp(name, tiles, files, buffer, performer)
    if not _is_current(world, stamp, tiles, files):
        temporary = out / ".world"
        try:
            shutil.rmtree(temporary, ignore_errors=True)
            _write(temporary, name, tiles, buffer, performer, dome, failed)
            (temporary / STAMP_FILE).write_text(stamp, encoding="utf-8")
            swap(temporary, world)
        except OSError as error:
            raise from_os_error(error, out) from None
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    else:
        for path in _edited(world):
            warn(f"{path} was changed since it was written and is kept: delete {world} to rebuild it")
    return world / f"{name}.sdf"


def add_roads(out: Path) -> None:
    """Write the combined roads of all tiles into the world in `out`, once: `<name>.xodr` and `<name>_roads.geojson`.

    Without lanes neither is written.

    Raises:
        InputError: the world is incomplete.
        SpaceError: the disk is full or not writable.
    """
    world = out / "world"
    if (world / ROADS_STAMP_FILE).is_file():
        return
    try:
        opendrive.write_roads(scene.read_scene(world), world)
        (world / ROADS_STAMP_FILE).touch()
        os.utime(world / STAMP_FILE)  # so that the roads don't count as users' edits
    except OSError as error:
        raise from_os_error(error, world) from None


def link(source: str, target: str) -> None:
    """Make `target` a hard link of `source`; a copy if that fails or users edit such files (edits stay in the copy)."""
    try:
        if Path(source).suffix in USER_EDITABLE_SUFFIXES:
            raise OSError("users edit this file")
        os.link(source, target)
    except OSError:
        copy_with_time(Path(source), Path(target))


def same_file(source: Path, copy: Path) -> bool:
    """Whether `copy` was made by `link` from the source, and neither has changed since."""
    try:
        a, b = source.stat(), copy.stat()
    except OSError:
        return False
    return os.path.samestat(a, b) or (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)


def same_unless_edited(source: Path, copy: Path) -> bool:
    """`same_file`; of files that users edit, only whether the copy exists."""
    return copy.is_file() if copy.suffix in USER_EDITABLE_SUFFIXES else same_file(source, copy)


def swap(new: Path, target: Path) -> None:
    """Rename a finished folder to `target`; an existing folder there is deleted afterwards.

    NFS can't delete the folder of a file that a program (a simulator, say) has open: that is tried again next time.
    """
    prefix = f".{target.name}-earlier"
    if target.exists():
        target.rename(new_folder(target.parent, f"{prefix}-") / target.name)
    new.rename(target)
    for earlier in target.parent.glob(f"{prefix}*"):
        shutil.rmtree(earlier, ignore_errors=True)


def _check(tiles: Sequence[TileWorld]) -> None:
    first = tiles[0]
    names = set[str]()
    for tile in tiles:
        scene_file = tile.world / scene.SCENE_FOLDER / scene.SCENE_FILE
        for file in (tile.world / "metadata.json", tile.model / "model.sdf", scene_file):
            if not file.is_file():
                raise InputError(file, "file not found", 'Export the tile again, with "gazebo" in export.formats')
        if tile.name in names:
            raise InputError(tile.world, f"is a second tile named {tile.name}", "Give each tile a unique name")
        if not _same_system(tile.frame, first.frame):
            raise InputError(
                tile.world,
                f"is in {crs.name(tile.frame.crs)} ({tile.frame.unit:g} m per unit), but {first.name} is in "
                f"{crs.name(first.frame.crs)} ({first.frame.unit:g} m per unit)",
                "Reproject all tiles of a survey to one CRS first",
            )
        names.add(tile.name)


def _same_system(a: Frame, b: Frame) -> bool:
    """Whether two frames have the same CRS, given as code or WKT, and unit."""
    if (a.crs, a.unit) == (b.crs, b.unit):
        return True
    name = crs.name(a.crs)
    return a.unit == b.unit and name.startswith("EPSG:") and name == crs.name(b.crs)


def _stamp(name: str, tiles: Sequence[TileWorld], files: dict[str, list[Path]], buffer: float, performer: str) -> str:
    """Hash of all inputs of the world; files by their sizes and modification times."""
    parts: list[Any] = [VERSION, name, buffer, performer]
    for tile in tiles:
        paths = [tile.world / "metadata.json", *(tile.world / file for file in files[tile.name])]
        stats = [(path.relative_to(tile.world).as_posix(), path.stat()) for path in paths]
        parts += [tile.name, asdict(tile.frame), [(path, s.st_size, s.st_mtime_ns) for path, s in stats]]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _is_current(world: Path, stamp: str, tiles: Sequence[TileWorld], files: dict[str, list[Path]]) -> bool:
    """Whether the world was built from these tiles, and has their meshes and textures."""
    try:
        same = (world / STAMP_FILE).read_text(errors="replace", encoding="utf-8") == stamp
    except OSError:
        return False
    pairs = [(tile.world / file, world / file) for tile in tiles for file in files[tile.name]]
    return same and _has_dome(world) and all(same_unless_edited(file, copy) for file, copy in pairs)


def _stamp_dome(world: Path, dome: scene.SceneTile | None) -> None:
    """Record the files of the sky dome, which are no copies of a tile's: sizes and modification times by path."""
    folders = (dome.folder, world / "models" / dome.name) if dome else ()
    files = sorted(path for folder in folders for path in folder.rglob("*") if path.is_file())
    stats = {p.relative_to(world).as_posix(): p.stat() for p in files if p.suffix not in USER_EDITABLE_SUFFIXES}
    text = json.dumps({path: [s.st_size, s.st_mtime_ns] for path, s in stats.items()})
    (world / DOME_STAMP_FILE).write_text(text, encoding="utf-8")


def _has_dome(world: Path) -> bool:
    """Whether all files of the sky dome are as they were written."""
    try:
        made = json.loads((world / DOME_STAMP_FILE).read_text(encoding="utf-8"))
        stats = {path: (world / path).stat() for path in made}
    except (OSError, ValueError):
        return False
    return all(made[path] == [s.st_size, s.st_mtime_ns] for path, s in stats.items())


def _edited(world: Path) -> list[Path]:
    """Files that were modified after the world was finished: edits of the user, or damage."""
    finished = (world / STAMP_FILE).stat().st_mtime_ns
    return [
        p for p in sorted(world.rglob("*")) if p.suffix in USER_EDITABLE_SUFFIXES and p.stat().st_mtime_ns > finished
    ]


def _write(
    folder: Path,
    name: str,
    tiles: Sequence[TileWorld],
    buffer: float,
    performer: str,
    dome: MakeDome,
    failed: dict[str, ScanError] | None,
) -> None:
    metadata = {tile.name: _metadata(tile.world / "metadata.json") for tile in tiles}
    origin = _origin(tiles, metadata)
    first = tiles[0].frame
    georeference = sdf.Georeference.of(Frame(first.crs, origin, first.unit))
    placed = [_place(tile, metadata[tile.name], origin) for tile in tiles]
    for tile in tiles:
        for subfolder in (Path("models") / tile.name, Path(scene.SCENE_FOLDER) / tile.name):
            copy_tree(tile.world / subfolder, folder / subfolder, link)
    scene.write_scene_file(folder, name, Frame(first.crs, origin, first.unit), [tile.name for tile in tiles])
    whole, sky = scene.read_scene(folder), dict[str, int]()
    with optional_part("sky_dome", folder, failed):
        whole, sky = _add_dome(folder, whole, dome)
    with optional_part("spawn", folder, failed):
        whole = replace(whole, spawn=default_pose(whole))
    shown = {whole.dome.name: whole.dome.offset} if whole.dome else {}
    sdf.write_levels(
        folder / f"{name}.sdf", name, georeference, placed, buffer, performer, None, whole.sky, shown,
        spawn=whole.spawn,
    )  # fmt: skip
    with optional_part("traffic", folder, failed) as place:
        gazebo.write_traffic(whole, place)
    body = {
        "name": name,
        "crs": first.crs,
        "unit_m": first.unit,
        "to_crs": "crs = (world + world_origin_m) / unit_m; world = local + offset_m, local as in a tile's meshes",
        "world_origin_m": list(origin),
        "wgs84": georeference and georeference.as_metadata(),
        "buffer_m": buffer,
        "performer": performer,
        **world_formats.sky_metadata(whole),
        **world_formats.spawn_metadata(whole),
        "tiles": {
            tile.name: {
                "origin_m": list(tile.frame.origin),
                "offset_m": list(model.offset),
                "low_m": list(model.low),
                "high_m": list(model.high),
            }
            for tile, model in zip(tiles, placed, strict=True)
        },
        "triangles_by_file": {file: n for one in metadata.values() for file, n in _model_triangles(one).items()} | sky,
    }
    (folder / "metadata.json").write_text(json.dumps(body, indent=2) + "\n", encoding="utf-8")
    with optional_part("readme", folder, failed) as place:
        readme.write(place, whole, ["gazebo"])
    if not failed:  # otherwise the next call writes the world again
        _stamp_dome(folder, whole.dome)


def _add_dome(folder: Path, whole: scene.Scene, dome: MakeDome) -> tuple[scene.Scene, dict[str, int]]:
    """Write the sky dome below `folder`, or nothing on errors; returns the scene with it, and triangles by file."""
    made = [folder / scene.SCENE_FOLDER / scene.DOME_FOLDER]
    try:
        domed = scene.add_dome(whole, folder, dome)
        if domed.dome is not None:
            made.append(folder / "models" / domed.dome.name)
        return domed, gazebo.write_dome(folder, domed, SceneParams())
    except Exception:
        for path in made:
            shutil.rmtree(path, ignore_errors=True)
        raise


def _metadata(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise InputError(path, f"is not valid JSON ({error})", "Fix it, or export the tile again") from None


def _model_triangles(metadata: dict[str, Any]) -> dict[str, int]:
    """Number of triangles by mesh file of a tile's model; other files stay in the tile's world."""
    return {file: n for file, n in metadata["triangles_by_file"].items() if file.startswith("models/")}


def _origin(tiles: Sequence[TileWorld], metadata: Mapping[str, Mapping[str, Any]]) -> sdf.Vector:
    """Origin of the tile nearest to the middle of the survey, so that coordinates are small: on its ground."""
    origins = np.array([tile.frame.origin for tile in tiles])
    middle = (origins.min(axis=0) + origins.max(axis=0)) / 2
    nearest = int(np.argmin(np.linalg.norm(origins - middle, axis=1)))
    x, y, _ = np.round(origins[nearest]).tolist()
    return x, y, float(metadata[tiles[nearest].name]["world_origin_m"][2])


def _place(tile: TileWorld, metadata: dict[str, Any], origin: sdf.Vector) -> sdf.PlacedModel:
    """Position of a tile's model in the world, and the bounding box of all its groups."""
    groups = metadata["groups"].values()
    low = np.min([group["low_m"] for group in groups], axis=0).tolist()
    high = np.max([group["high_m"] for group in groups], axis=0).tolist()
    offset = np.subtract(tile.frame.origin, origin).tolist()
    return sdf.PlacedModel(tile.name, tuple(offset), tuple(low), tuple(high))
