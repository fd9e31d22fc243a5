"""A finished world as a scene: textured surfaces by class, what bodies collide with, where all of it is on the map.

Whatever writes a world reads a scene: the step `export`, and `scan2sim export` long afterwards. It is kept without loss
in the world's folder, `scene/` (files of earlier steps as hard links, so it takes hardly any room), and goes with it:

    scene/scene.json                name, origin and tiles
    scene/<tile>/tile.json          frame, friction, and figures of each surface
    scene/<tile>/<group>/           a textured mesh, as `pipeline.io.worlds.textured_mesh` reads it; `photo.npy` tells
                                    which photo
                                    gives each face its detail, by its number among
    scene/<tile>/views.json         the photos' poses, where there are photos
    scene/<tile>/collision.npz      what bodies collide with
    scene/<tile>/*.geojson, *.csv   lists of what stands where
    scene/<tile>/roads.npz          what was seen of roads (`pipeline.roads.observed`), where the step `roads` was run
    scene/<tile>/path.npz           where the recording device went, local metres, where that is known
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
from scan2sim.pipeline.io.file_checks import make_folder, pass_on
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh as textured
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.simulation.robot import Start

FOLDER, ABOUT, TILE, SOLID = "scene", "scene.json", "tile.json", "collision.npz"
ROADS, PATH, VIEWS = "roads.npz", "path.npz", "views.json"
VERSION = 1
"""Of what is kept."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """The faces of one class.

    Attributes:
        name: unique in its tile: "building", and of street furniture "building_pole".
        group: the surface that it belongs to, whose pages it shares.
        code: LAS code of its class, which is its label in all formats.
        shape: the faces, local metres, z up.
    """

    name: str
    group: str
    code: int
    shape: Textured

    @property
    def label(self) -> str:
        """What its class is called: "pole"."""
        return name_of(self.code)

    def on_page(self, page: int) -> Surface:
        """The faces on a texture page."""
        return replace(self, shape=self.shape.on_page(page))

    def seen(self) -> U8 | None:
        """(F,) what the middle of each face has its colour from, as the step `texture` codes it; None: not known."""
        from scan2sim.pipeline.camera.image_sampling import of_uv

        shape = self.shape
        assert shape.mesh.uv is not None and shape.mesh.page is not None
        if len(shape.seen) < len(shape.pages):
            return None
        found = np.zeros(len(shape), np.uint8)
        for page in shape.used_pages:
            here = shape.mesh.page == page
            levels = image.read_levels(shape.seen[page])
            column, row = of_uv(levels, *shape.mesh.uv[here].mean(axis=1).T)
            rows, columns = levels.shape
            found[here] = levels[
                np.rint(row).astype(int).clip(0, rows - 1), np.rint(column).astype(int).clip(0, columns - 1)
            ]
        return found

    def parts(self, limit: int) -> list[Surface]:
        """Compact parts of at most `limit` triangles, named `_part1` and on; itself where it is small enough."""
        shapes = self.shape.parts(limit)
        if len(shapes) == 1:
            return [self]
        return [replace(self, name=f"{self.name}_part{i}", shape=shape) for i, shape in enumerate(shapes, start=1)]


@dataclass(frozen=True)
class SceneTile:
    """A tile of a scene; what is large stays on the disk until it is asked for.

    Attributes:
        name: unique in its scene, a name for files everywhere.
        frame: of all that is local in it.
        offset: metres from the scene's origin to the tile's.
        friction: Coulomb friction coefficient of its ground.
        groups: figures of each surface: `triangles`, `vertices`, `pages`, `low_m` and `high_m` (local).
        folder: where it is kept.
    """

    name: str
    frame: Frame
    offset: Vector
    friction: float
    groups: Mapping[str, Mapping[str, Any]]
    folder: Path

    def textured(self) -> dict[str, Textured]:
        """Its surfaces whole, by group."""
        read = {group: textured.read(self.folder / group) for group in self.groups}
        return {group: shape for group, shape in read.items() if shape is not None}

    def surfaces(self) -> list[Surface]:
        """Its surfaces by class."""
        return [surface for group, shape in self.textured().items() for surface in by_class(group, shape)]

    def solid(self) -> Mesh:
        """What bodies collide with."""
        return Mesh.load(self.folder / SOLID)

    def views(self) -> tuple[View, ...]:
        """Its photos' poses, local metres, their files as names alone; empty in worlds of earlier versions."""
        return views_io.load(self.folder / VIEWS) if (self.folder / VIEWS).is_file() else ()

    @property
    def lists(self) -> dict[str, Path]:
        """Lists of what stands where (plants, furniture, things), by their files' names; places are in the CRS."""
        return {path.name: path for path in sorted(self.folder.iterdir()) if path.suffix in (".geojson", ".csv")}

    @property
    def known(self) -> dict[str, Path]:
        """All that is kept beside its meshes, by the files' names: lists, roads, the path."""
        return self.lists | {name: self.folder / name for name in (ROADS, PATH) if (self.folder / name).is_file()}

    @property
    def low(self) -> Vector:
        """Lowest corner of the box around all surfaces, local metres."""
        x, y, z = np.min([group["low_m"] for group in self.groups.values()], axis=0).tolist()
        return x, y, z

    @property
    def high(self) -> Vector:
        """Highest corner of the box around all surfaces, local metres."""
        x, y, z = np.max([group["high_m"] for group in self.groups.values()], axis=0).tolist()
        return x, y, z


@dataclass(frozen=True)
class Level:
    """A level of detail: what is shown from afar in place of finer levels.

    Attributes:
        tile: what is shown, a tile made smaller or several as one; where there is nothing finer, the scene's own.
        height: levels below it.
        error: metres from what the scene's own tiles show, p95 (`texturing.levels_of_detail`).
        texel: metres that one of its texels spans.
        finer: what it stands for.
    """

    tile: SceneTile
    height: int = 0
    error: float = 0.0
    texel: float = 0.0
    finer: tuple[Level, ...] = ()

    def stands_for(self) -> list[SceneTile]:
        """The scene's own tiles."""
        return [tile for finer in self.finer for tile in finer.stands_for()] or [self.tile]


@dataclass(frozen=True)
class Scene:
    """A finished world.

    Attributes:
        name: a name for files everywhere.
        frame: CRS, and the scene's origin in it.
        tiles: in the order of their names.
        coarse: levels of detail of all tiles, the coarsest, where they were made.
        start: of a robot, where it is exported with one.
    """

    name: str
    frame: Frame
    tiles: tuple[SceneTile, ...]
    coarse: Level | None = None
    start: Start | None = None

    def levels(self, tile: SceneTile) -> list[Level]:
        """A tile at all levels that are of itself alone, the finest first."""
        found, above = [Level(tile)], [self.coarse] if self.coarse else []
        while above:
            level = above.pop()
            if {one.name for one in level.stands_for()} == {tile.name} and level.finer:
                found.insert(1, level)
            above += level.finer
        return found

    @property
    def origin(self) -> Vector:
        """Metres in the CRS: world coordinates are local ones plus a tile's offset; the CRS's are those plus this."""
        return self.frame.origin


def whole(group: str, shape: Textured) -> Surface:
    """A group as one surface."""
    return Surface(group, group, CODE_OF_SURFACE[group], shape)


def by_class(group: str, shape: Textured) -> list[Surface]:
    """A group's faces parted by their class; those without one are the group's own."""
    codes = shape.mesh.classification
    if codes is None:
        return [whole(group, shape)]
    parts = []
    for code in np.unique(codes).tolist():
        name = f"{group}_{name_of(code)}" if code else group
        parts.append(Surface(name, group, code or CODE_OF_SURFACE[group], shape.keep(codes == code)))
    return parts


def keep(
    world: Path,
    name: str,
    surfaces: Mapping[str, Path],
    solid: Path,
    lists: Mapping[str, Path],
    friction: float,
    origin: Vector | None = None,
    views: Sequence[View] = (),
    photos: Mapping[str, I32] | None = None,
) -> Scene:
    """Keep a tile's results as a scene below `world`.

    Args:
        world: the world's folder.
        name: of the tile and the scene.
        surfaces: folders of textured meshes, by group; empty ones are left out.
        solid: the collision mesh.
        lists: files of all that is kept beside the meshes, by the names that they get.
        friction: of the ground.
        origin: of the scene, metres in the CRS; default: the tile's own.
        views: the tile's photos.
        photos: of groups, (F,) which of them gives each face its detail, -1: none.

    Raises:
        DataError: no group has a face.
        InputError: a textured mesh is incomplete, or in another frame than the collision mesh.
    """
    frame: Frame = Mesh.load(solid).frame
    read = {group: textured.read(surfaces[group]) for group in SURFACES if group in surfaces}
    shapes = {group: shape for group, shape in read.items() if shape is not None}
    if not shapes:
        raise DataError("export", "there is nothing to show: every surface is empty", "Check the classes of the cloud")
    folder = world / FOLDER / name
    make_folder(folder)
    for group, shape in shapes.items():
        if shape.mesh.frame != frame:
            raise InputError(
                surfaces[group],
                f"has the origin {shape.mesh.frame.origin}, the collision mesh {frame.origin}",
                "Make all meshes of a tile from the same ingested cloud",
            )
        make_folder(folder / group)
        for file in ("mesh.npz", *(page.name for page in shape.pages), *(page.name for page in shape.seen)):
            pass_on(surfaces[group] / file, folder / group / file)
        if photos is not None and group in photos:
            np.save(folder / group / textured.PHOTO, photos[group])
    if views:
        views_io.save(folder / VIEWS, [replace(view, photo=Path(view.photo.name), mask=None) for view in views])
    pass_on(solid, folder / SOLID)
    for file, path in lists.items():
        pass_on(path, folder / file)
    about = {
        "version": VERSION,
        **_frame_as_json(frame),
        "friction": friction,
        "groups": {group: figures(shape) for group, shape in shapes.items()},
    }
    _write(folder / TILE, about)
    describe(world, name, Frame(frame.crs, origin or frame.origin, frame.unit), [name])
    return read_scene(world)


def describe(world: Path, name: str, frame: Frame, tiles: list[str]) -> None:
    """Write what a scene is made of: `tiles`, which are kept below `world`, around the origin of `frame`."""
    about = {"version": VERSION, "name": name, **_frame_as_json(frame), "tiles": tiles}
    _write(world / FOLDER / ABOUT, about)


def read_scene(world: Path) -> Scene:
    """The scene of a world's folder, or of the folder that a run or a survey was given as its output.

    Raises:
        InputError: there is no world; it was made by a version that kept no scene, or another one; it is incomplete.
    """
    place = _place(world)
    about = _read(place / ABOUT)
    frame = _frame(place / ABOUT, about)
    try:
        tiles = tuple(_tile(place / name, frame) for name in about["tiles"])
        return Scene(about["name"], frame, tiles)
    except (KeyError, TypeError) as error:
        raise InputError(place / ABOUT, f"lacks {error}", ANEW) from None


ANEW = "Run `scan2sim run` (or `survey`) again as before: its export is made anew, and what hasn't changed is kept"


def _place(world: Path) -> Path:
    """Where a world's scene is kept."""
    for folder in (world / "world", world):
        if (folder / FOLDER / ABOUT).is_file():
            return folder / FOLDER
    for folder in (world / "world", world):
        if (folder / "metadata.json").is_file():
            raise InputError(folder, "was made by an earlier version, which kept no scene to export", ANEW)
    raise InputError(world, "holds no world", "Name the folder that was given to run or survey by --out")


def _tile(folder: Path, frame: Frame) -> SceneTile:
    about = _read(folder / TILE)
    own = _frame(folder / TILE, about)
    x, y, z = (here - there for here, there in zip(own.origin, frame.origin, strict=True))
    return SceneTile(folder.name, own, (x, y, z), about["friction"], about["groups"], folder)


def figures(shape: Textured) -> dict[str, Any]:
    """Of a group, as `SceneTile.groups` has them."""
    return {
        "triangles": len(shape),
        "vertices": len(shape.mesh.vertices),
        "pages": len(shape.used_pages),
        "low_m": np.round(shape.mesh.vertices.min(axis=0).astype(float), 3).tolist(),
        "high_m": np.round(shape.mesh.vertices.max(axis=0).astype(float), 3).tolist(),
    }


def _frame_as_json(frame: Frame) -> dict[str, Any]:
    return {"crs": frame.crs, "origin_m": list(frame.origin), "unit_m": frame.unit}


def _frame(path: Path, about: Mapping[str, Any]) -> Frame:
    try:
        x, y, z = about["origin_m"]
        return Frame(about["crs"], (x, y, z), about["unit_m"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(path, f"says nothing of where it is ({error})", ANEW) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        about = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(path, f"can't be read ({error})", ANEW) from None
    if about.get("version") != VERSION:
        raise InputError(path, f"is of version {about.get('version')}, this program reads {VERSION}", ANEW)
    return about


def _write(path: Path, about: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
