"""A finished world as a scene: textured surfaces by class, collision mesh, georeference.

All writers of worlds read a scene: the step `export`, and `scan2sim export` at any later time. It is stored losslessly
in `scene/` of the world's folder (files of earlier steps as hard links, so that it takes hardly any disk space):

    scene/scene.json                name, origin and tiles
    scene/<tile>/tile.json          frame, friction, and statistics of each surface
    scene/<tile>/<group>/           a textured mesh (`pipeline.io.worlds.textured_mesh`); its `photo.npy` is the index
                                    of the photo in views.json that gives each face its detail
    scene/<tile>/views.json         the photos' poses, if there are photos
    scene/<tile>/collision.npz      collision mesh
    scene/<tile>/*.geojson, *.csv   lists of detected objects and their positions
    scene/<tile>/roads.npz          observed roads (`pipeline.roads.observed`), if the step `roads` was run
    scene/<tile>/path.npz           trajectory of the recording device, local metres, if known
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CODE_OF_SURFACE, SURFACES, name_of
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import I32, U8, Frame, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import link_or_copy, make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh as textured
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.simulation.robot import Start

SCENE_FOLDER, SCENE_FILE, TILE_FILE, COLLISION_FILE = "scene", "scene.json", "tile.json", "collision.npz"
ROADS_FILE, PATH_FILE, VIEWS_FILE = "roads.npz", "path.npz", "views.json"
VERSION = 1
"""Version of the files' format."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """The faces of one class.

    Attributes:
        name: unique in its tile: "building"; for street furniture "building_pole".
        group: the surface that it is part of and whose texture pages it shares.
        code: LAS code of its class, which is its label in all formats.
        shape: the faces, local metres, z up.
    """

    name: str
    group: str
    code: int
    shape: Textured

    @property
    def label(self) -> str:
        """Name of its class, for example "pole"."""
        return name_of(self.code)

    def on_page(self, page: int) -> Surface:
        """The faces on a texture page."""
        return replace(self, shape=self.shape.on_page(page))

    def seen(self) -> U8 | None:
        """Source (F,) of the colour at the centre of each face, in the levels of the step `texture`; None: unknown."""
        from scan2sim.pipeline.camera.image_sampling import uv_to_pixel

        shape = self.shape
        assert shape.mesh.uv is not None and shape.mesh.page is not None
        if len(shape.seen) < len(shape.pages):
            return None
        found = np.zeros(len(shape), np.uint8)
        for page in shape.used_pages:
            on_page = shape.mesh.page == page
            levels = image.read_levels(shape.seen[page])
            column, row = uv_to_pixel(levels, *shape.mesh.uv[on_page].mean(axis=1).T)
            rows, columns = levels.shape
            found[on_page] = levels[
                np.rint(row).astype(int).clip(0, rows - 1), np.rint(column).astype(int).clip(0, columns - 1)
            ]
        return found

    def parts(self, limit: int) -> list[Surface]:
        """Compact parts of at most `limit` triangles, named `_part1` and so on; itself if it is small enough."""
        shapes = self.shape.parts(limit)
        if len(shapes) == 1:
            return [self]
        return [replace(self, name=f"{self.name}_part{i}", shape=shape) for i, shape in enumerate(shapes, start=1)]


@dataclass(frozen=True)
class SceneTile:
    """A tile of a scene; meshes are read from disk on demand.

    Attributes:
        name: unique in its scene; used as file name in all formats.
        frame: frame of its local coordinates.
        offset: metres from the scene's origin to the tile's.
        friction: Coulomb friction coefficient of its ground.
        groups: statistics of each surface: `triangles`, `vertices`, `pages`, `low_m` and `high_m` (local).
        folder: folder with its files.
    """

    name: str
    frame: Frame
    offset: Vector
    friction: float
    groups: Mapping[str, Mapping[str, Any]]
    folder: Path

    def textured(self) -> dict[str, Textured]:
        """Its complete surfaces, by group."""
        read = {group: textured.read(self.folder / group) for group in self.groups}
        return {group: shape for group, shape in read.items() if shape is not None}

    def surfaces(self) -> list[Surface]:
        """Its surfaces by class."""
        return [surface for group, shape in self.textured().items() for surface in by_class(group, shape)]

    def solid(self) -> Mesh:
        """The collision mesh."""
        return Mesh.load(self.folder / COLLISION_FILE)

    def views(self) -> tuple[View, ...]:
        """Its photos' poses in local metres, with bare file names; empty for worlds of earlier versions."""
        return views_io.load(self.folder / VIEWS_FILE) if (self.folder / VIEWS_FILE).is_file() else ()

    @property
    def lists(self) -> dict[str, Path]:
        """Lists of detected objects (plants, furniture, instances), by file name; positions are in the CRS."""
        return {path.name: path for path in sorted(self.folder.iterdir()) if path.suffix in (".geojson", ".csv")}

    @property
    def extra_files(self) -> dict[str, Path]:
        """All files besides its meshes, by file name: lists, roads, the path."""
        return self.lists | {
            name: self.folder / name for name in (ROADS_FILE, PATH_FILE) if (self.folder / name).is_file()
        }

    @property
    def low(self) -> Vector:
        """Lowest corner of the bounding box of all surfaces, local metres."""
        x, y, z = np.min([group["low_m"] for group in self.groups.values()], axis=0).tolist()
        return x, y, z

    @property
    def high(self) -> Vector:
        """Highest corner of the bounding box of all surfaces, local metres."""
        x, y, z = np.max([group["high_m"] for group in self.groups.values()], axis=0).tolist()
        return x, y, z


@dataclass(frozen=True)
class Level:
    """A level of detail (LOD), which replaces finer levels at a distance.

    Attributes:
        tile: its content, a simplified tile or several merged ones; for the finest level the scene's own tile.
        height: number of levels below it.
        error: distance (m) from the surfaces of the scene's own tiles, p95 (`texturing.levels_of_detail`).
        texel: size of a texel, metres.
        finer: the levels that it replaces.
    """

    tile: SceneTile
    height: int = 0
    error: float = 0.0
    texel: float = 0.0
    finer: tuple[Level, ...] = ()

    def source_tiles(self) -> list[SceneTile]:
        """The scene's own tiles that it represents."""
        return [tile for finer in self.finer for tile in finer.source_tiles()] or [self.tile]


@dataclass(frozen=True)
class Scene:
    """A finished world.

    Attributes:
        name: used as file name in all formats.
        frame: CRS, and the scene's origin in it.
        tiles: ordered by name.
        coarse: root of the levels of detail of all tiles, or None.
        start: start pose of the robot, if it is exported.
    """

    name: str
    frame: Frame
    tiles: tuple[SceneTile, ...]
    coarse: Level | None = None
    start: Start | None = None

    def levels(self, tile: SceneTile) -> list[Level]:
        """All levels of detail that contain only this tile, the finest first."""
        found, pending = [Level(tile)], [self.coarse] if self.coarse else []
        while pending:
            level = pending.pop()
            if {one.name for one in level.source_tiles()} == {tile.name} and level.finer:
                found.insert(1, level)
            pending += level.finer
        return found

    @property
    def origin(self) -> Vector:
        """Origin in the CRS, metres. World = local + offset of the tile; CRS = world + this origin."""
        return self.frame.origin


def group_surface(group: str, shape: Textured) -> Surface:
    """A group as a single surface."""
    return Surface(group, group, CODE_OF_SURFACE[group], shape)


def by_class(group: str, shape: Textured) -> list[Surface]:
    """Split a group's faces by class; faces without a class get the class of the group."""
    codes = shape.mesh.classification
    if codes is None:
        return [group_surface(group, shape)]
    parts = []
    for code in np.unique(codes).tolist():
        name = f"{group}_{name_of(code)}" if code else group
        parts.append(Surface(name, group, code or CODE_OF_SURFACE[group], shape.keep(codes == code)))
    return parts


def save_tile(
    world: Path,
    name: str,
    surfaces: Mapping[str, Path],
    solid: Path,
    extra_files: Mapping[str, Path],
    friction: float,
    origin: Vector | None = None,
    views: Sequence[View] = (),
    photos: Mapping[str, I32] | None = None,
) -> Scene:
    """Save a tile's results as a scene below `world`.

    Args:
        world: the world's folder.
        name: name of the tile and the scene.
        surfaces: folders of textured meshes, by group; empty meshes are skipped.
        solid: the collision mesh.
        extra_files: further files to store, by their names in the scene.
        friction: Coulomb friction coefficient of the ground.
        origin: origin of the scene, metres in the CRS; default: the tile's own.
        views: the tile's photos.
        photos: by group, (F,) index of the photo that gives each face its detail, -1: none.

    Raises:
        DataError: no group has faces.
        InputError: a textured mesh is incomplete, or its frame differs from that of the collision mesh.
    """
    frame: Frame = Mesh.load(solid).frame
    read = {group: textured.read(surfaces[group]) for group in SURFACES if group in surfaces}
    shapes = {group: shape for group, shape in read.items() if shape is not None}
    if not shapes:
        raise DataError("export", "all surfaces are empty", "Check the classes of the cloud")
    folder = world / SCENE_FOLDER / name
    make_folder(folder)
    for group, shape in shapes.items():
        if shape.mesh.frame != frame:
            raise InputError(
                surfaces[group],
                f"has the origin {shape.mesh.frame.origin}, but the collision mesh has {frame.origin}",
                "Build all meshes of a tile from the same ingested cloud",
            )
        make_folder(folder / group)
        for file in ("mesh.npz", *(page.name for page in shape.pages), *(page.name for page in shape.seen)):
            link_or_copy(surfaces[group] / file, folder / group / file)
        if photos is not None and group in photos:
            np.save(folder / group / textured.PHOTO_FILE, photos[group])
    if views:
        views_io.save(folder / VIEWS_FILE, [replace(view, photo=Path(view.photo.name), mask=None) for view in views])
    link_or_copy(solid, folder / COLLISION_FILE)
    for file, path in extra_files.items():
        link_or_copy(path, folder / file)
    body = {
        "version": VERSION,
        **_frame_as_json(frame),
        "friction": friction,
        "groups": {group: statistics(shape) for group, shape in shapes.items()},
    }
    _write(folder / TILE_FILE, body)
    write_scene_file(world, name, Frame(frame.crs, origin or frame.origin, frame.unit), [name])
    return read_scene(world)


def write_scene_file(world: Path, name: str, frame: Frame, tiles: list[str]) -> None:
    """Write `scene.json` below `world`: name, origin and CRS (`frame`), and names of the tiles."""
    body = {"version": VERSION, "name": name, **_frame_as_json(frame), "tiles": tiles}
    _write(world / SCENE_FOLDER / SCENE_FILE, body)


def read_scene(world: Path) -> Scene:
    """Read the scene of a world's folder, or of the output folder of a run or survey.

    Raises:
        InputError: no world found, or it is incomplete, or was written by an incompatible version.
    """
    folder = _find_scene(world)
    body = _read(folder / SCENE_FILE)
    frame = _frame(folder / SCENE_FILE, body)
    try:
        tiles = tuple(_tile(folder / name, frame) for name in body["tiles"])
        return Scene(body["name"], frame, tiles)
    except (KeyError, TypeError) as error:
        raise InputError(folder / SCENE_FILE, f"has no valid {error}", EXPORT_AGAIN) from None


EXPORT_AGAIN = "Run `scan2sim run` (or `survey`) again: it repeats the export and reuses all unchanged results"


def _find_scene(world: Path) -> Path:
    """The folder with a world's scene."""
    for folder in (world / "world", world):
        if (folder / SCENE_FOLDER / SCENE_FILE).is_file():
            return folder / SCENE_FOLDER
    for folder in (world / "world", world):
        if (folder / "metadata.json").is_file():
            raise InputError(folder, "was written by an earlier version, without a scene to export", EXPORT_AGAIN)
    raise InputError(world, "contains no world", "Give the output folder (--out) of run or survey")


def _tile(folder: Path, frame: Frame) -> SceneTile:
    body = _read(folder / TILE_FILE)
    tile_frame = _frame(folder / TILE_FILE, body)
    x, y, z = (tile - scene for tile, scene in zip(tile_frame.origin, frame.origin, strict=True))
    return SceneTile(folder.name, tile_frame, (x, y, z), body["friction"], body["groups"], folder)


def statistics(shape: Textured) -> dict[str, Any]:
    """Statistics of a group, as in `SceneTile.groups`."""
    return {
        "triangles": len(shape),
        "vertices": len(shape.mesh.vertices),
        "pages": len(shape.used_pages),
        "low_m": np.round(shape.mesh.vertices.min(axis=0).astype(float), 3).tolist(),
        "high_m": np.round(shape.mesh.vertices.max(axis=0).astype(float), 3).tolist(),
    }


def _frame_as_json(frame: Frame) -> dict[str, Any]:
    return {"crs": frame.crs, "origin_m": list(frame.origin), "unit_m": frame.unit}


def _frame(path: Path, body: Mapping[str, Any]) -> Frame:
    try:
        x, y, z = body["origin_m"]
        return Frame(body["crs"], (x, y, z), body["unit_m"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(path, f"has no valid origin and CRS ({error})", EXPORT_AGAIN) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        body = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(path, f"can't be read ({error})", EXPORT_AGAIN) from None
    if body.get("version") != VERSION:
        cause = f"has version {body.get('version')}, but this program reads version {VERSION}"
        raise InputError(path, cause, EXPORT_AGAIN)
    return body


def _write(path: Path, body: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(body, indent=2) + "\n", encoding="utf-8")
