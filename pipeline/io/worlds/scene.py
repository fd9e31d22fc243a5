"""A finished world as a scene: textured surfaces by class, collision mesh, georeference.

All writers of worlds read a scene: the step `export`, and `scan2sim export` at any later time. It is stored losslessly
in `scene/` of the world's folder (files of earlier steps as hard links, so that it takes hardly any disk space):

    scene/scene.json                name, origin and tiles
    scene/<tile>/tile.json          frame, friction, and statistics of each surface
    scene/<tile>/<group>/           a textured mesh (`pipeline.io.worlds.textured_mesh`); its `photo.npy` is the index
                                    of the photo in views.json that gives each face its detail, its `reflectance.npy`
                                    that of the vertices (step `reflectance`), 255 is 1
    scene/<tile>/backdrop/          what only cameras see (step `backdrop`), a textured mesh, if there is one
    scene/sky-dome/                 sky of a survey's world: `tile.json` without groups, `backdrop/` and an empty
                                    `collision.npz`
    scene/<tile>/views.json         the photos' poses, if there are photos
    scene/<tile>/collision.npz      collision mesh
    scene/<tile>/*.geojson, *.csv   lists of detected objects and their positions
    scene/<tile>/roads.npz          observed roads (`pipeline.roads.observed`), if the step `roads` was run
    scene/<tile>/path.npz           trajectory of the recording device, local metres, if known
    scene/<tile>/tracks.json        tracks of road users in local metres (`pipeline.tracking.tracks`), if there are any
    scene/<tile>/splats.npz         what cameras see (step `splats`)
    scene/<tile>/navigation.json    spawn pose and storeys (step `navigation`), and its files map*.yaml, .pgm, .pcd
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CODE_OF_SURFACE, SURFACES, name_of
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.types import F64, I32, U8, Colour, Frame, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import link_or_copy, make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh as textured
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.simulation.robot import Start

SCENE_FOLDER, SCENE_FILE, TILE_FILE, COLLISION_FILE = "scene", "scene.json", "tile.json", "collision.npz"
ROADS_FILE, PATH_FILE, VIEWS_FILE, TRACKS_FILE = "roads.npz", "path.npz", "views.json", "tracks.json"
SPLATS_FILE = "splats.npz"
LIST_SUFFIXES, TRACK_FILES = (".geojson", ".csv"), (TRACKS_FILE, "tracks_kitti.txt", "tracks_nuscenes.json")
NAVIGATION_FILE, NAVIGATION_SUFFIXES = "navigation.json", (".yaml", ".pgm", ".pcd")
BACKDROP, BACKDROP_PARTS = "backdrop", ("backdrop", "backdrop_sky")
"""Folder and group of the backdrop, and names of its parts: page 0 are layers of scenery, page 1 is the sky dome."""
LAYERS_PAGE, SKY_PAGE = range(len(BACKDROP_PARTS))
DOME_FOLDER = "sky-dome"
"""Folder of a survey's sky dome; a tile can't have this name."""
BACKDROP_CODE = 0
"""Label of the backdrop: that of the background in segmentation cameras."""
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
        return BACKDROP if self.group == BACKDROP else name_of(self.code)

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
        codes: LAS code of the faces of a group that have none of their own, where it isn't that of the group.
        sky: colour of what its photos show where it has nothing, sRGB 0 to 255, or None.
        shows_backdrop: whether its backdrop, if there is one, is exported.
    """

    name: str
    frame: Frame
    offset: Vector
    friction: float
    groups: Mapping[str, Mapping[str, Any]]
    folder: Path
    codes: Mapping[str, int] = field(default_factory=dict)
    sky: Colour | None = None
    shows_backdrop: bool = True

    def textured(self) -> dict[str, Textured]:
        """Its complete surfaces, by group."""
        read = {group: textured.read(self.folder / group) for group in self.groups}
        shapes = {group: shape for group, shape in read.items() if shape is not None}
        return shapes | {
            group: replace(shapes[group], mesh=_with_code(shapes[group].mesh, 0, code))
            for group, code in self.codes.items() if group in shapes
        }  # fmt: skip

    def surfaces(self) -> list[Surface]:
        """Its surfaces by class."""
        return [surface for group, shape in self.textured().items() for surface in by_class(group, shape)]

    def backdrop(self) -> list[Surface]:
        """What only cameras see beyond its surfaces: `BACKDROP_PARTS`, empty without a backdrop."""
        shape = textured.read(self.folder / BACKDROP) if self.has_backdrop else None
        pages = shape.used_pages if shape else []
        return [Surface(BACKDROP_PARTS[k], BACKDROP, BACKDROP_CODE, shape.on_page(k)) for k in pages if shape]

    @property
    def has_backdrop(self) -> bool:
        """Whether it shows more to cameras than was scanned."""
        return self.shows_backdrop and (self.folder / BACKDROP).is_dir()

    def splats(self) -> SplatLayer | None:
        """What cameras see of it; None: it was built without."""
        return SplatLayer.load(self.folder / SPLATS_FILE) if self.splat_count else None

    @property
    def splat_count(self) -> int:
        """Number of its splats; 0: it was built without."""
        path = self.folder / SPLATS_FILE
        return SplatLayer.count(path) if path.is_file() else 0

    def solid(self) -> Mesh:
        """The collision mesh."""
        mesh = Mesh.load(self.folder / COLLISION_FILE)
        for group, code in self.codes.items():
            mesh = _with_code(mesh, CODE_OF_SURFACE[group], code)
        return mesh

    def views(self) -> tuple[View, ...]:
        """Its photos' poses in local metres, with bare file names; empty for worlds of earlier versions."""
        return views_io.load(self.folder / VIEWS_FILE) if (self.folder / VIEWS_FILE).is_file() else ()

    @property
    def lists(self) -> dict[str, Path]:
        """Lists of detected objects (plants, furniture, instances) in the CRS, and files of tracks, by file name."""
        files = {path.name: path for path in sorted(self.folder.iterdir())}
        return {name: path for name, path in files.items() if path.suffix in LIST_SUFFIXES or name in TRACK_FILES}

    @property
    def navigation_files(self) -> dict[str, Path]:
        """Occupancy maps and points for localization, by file name."""
        return {path.name: path for path in sorted(self.folder.iterdir()) if path.suffix in NAVIGATION_SUFFIXES}

    def navigation(self) -> dict[str, Any] | None:
        """Spawn pose and storeys in world coordinates; None: the step `navigation` wasn't run, or failed."""
        path = self.folder / NAVIGATION_FILE
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None

    @property
    def extra_files(self) -> dict[str, Path]:
        """All files besides its meshes, by file name: lists, roads, the path, files for navigation."""
        names = (ROADS_FILE, PATH_FILE, NAVIGATION_FILE, TRACKS_FILE, SPLATS_FILE)
        others = {name: self.folder / name for name in names if (self.folder / name).is_file()}
        return self.lists | self.navigation_files | others

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


def _with_code(mesh: Mesh, old: int, new: int) -> Mesh:
    """The mesh with another code for its faces of code `old`."""
    codes = np.zeros(len(mesh), np.uint8) if mesh.classification is None else mesh.classification
    return replace(mesh, classification=np.where(codes == old, new, codes).astype(np.uint8))


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
class RobotMapFrame:
    """Frame of the robot's map that a world was made from.

    Attributes:
        T_world_map: (4, 4) rigid transform from the map, in metres, to the simulator's world.
        unit: metres per unit of the map: world = T_world_map · (unit · map).
    """

    T_world_map: F64
    unit: float = 1.0


@dataclass(frozen=True)
class Scene:
    """A finished world.

    Attributes:
        name: used as file name in all formats.
        frame: CRS, and the scene's origin in it.
        tiles: ordered by name.
        coarse: root of the levels of detail of all tiles, or None.
        start: start pose of the robot, if it is exported.
        spawn: pose for the user's robots, if one was found.
        robot_map: frame of the robot's map that it was made from, or None.
        dome: sky of a survey's world, a tile with nothing but a backdrop; None: tiles have their own, or none.
    """

    name: str
    frame: Frame
    tiles: tuple[SceneTile, ...]
    coarse: Level | None = None
    start: Start | None = None
    spawn: Start | None = None
    robot_map: RobotMapFrame | None = None
    dome: SceneTile | None = None

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
    def has_splats(self) -> bool:
        """Whether a tile has splats."""
        return any(tile.splat_count for tile in self.tiles)

    @property
    def has_backdrop(self) -> bool:
        """Whether a tile, or the dome, shows more to cameras than was scanned."""
        return any(tile.has_backdrop for tile in self.with_dome)

    @property
    def with_dome(self) -> tuple[SceneTile, ...]:
        """All tiles, and the dome, if there is one: what cameras see."""
        return self.tiles if self.dome is None else (*self.tiles, self.dome)

    @property
    def far(self) -> float | None:
        """Distance in metres to the farthest place of the dome from any tile; None without a dome."""
        if self.dome is None:
            return None
        (sky,) = self.dome.backdrop()
        low = np.min([np.add(tile.low, tile.offset) for tile in self.tiles], axis=0)
        high = np.max([np.add(tile.high, tile.offset) for tile in self.tiles], axis=0)
        places = sky.shape.mesh.vertices + np.asarray(self.dome.offset)
        return float(np.linalg.norm(np.maximum(np.abs(places - low), np.abs(places - high)), axis=1).max())

    @property
    def sky(self) -> Colour | None:
        """Median of its tiles' `sky`; None if none is known."""
        known = [tile.sky for tile in self.tiles if tile.sky is not None]
        if not known:
            return None
        red, green, blue = np.median(known, axis=0).round().astype(int).tolist()
        return red, green, blue

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
    robot_map: RobotMapFrame | None = None,
    codes: Mapping[str, int] | None = None,
    reflectance: Path | None = None,
    sky: Colour | None = None,
    backdrop: Path | None = None,
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
        robot_map: frame of the robot's map in the CRS (not relative to `origin`), or None.
        codes: as in `SceneTile`.
        reflectance: folder with the results of step `reflectance`, `GROUP/reflectance.npy`; None: they are in the
            folders of the textured meshes, if there are any.
        sky: as in `SceneTile`.
        backdrop: folder of a textured mesh that only cameras see, or None.

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
        known = (surfaces[group] if reflectance is None else reflectance / group) / textured.REFLECTANCE_FILE
        if known.is_file():
            link_or_copy(known, folder / group / textured.REFLECTANCE_FILE)
        if photos is not None and group in photos:
            np.save(folder / group / textured.PHOTO_FILE, photos[group])
    for path in backdrop.iterdir() if backdrop else ():
        make_folder(folder / BACKDROP)
        link_or_copy(path, folder / BACKDROP / path.name)
    if views:
        views_io.save(folder / VIEWS_FILE, [replace(view, photo=Path(view.photo.name), mask=None) for view in views])
    link_or_copy(solid, folder / COLLISION_FILE)
    for file, path in extra_files.items():
        link_or_copy(path, folder / file)
    body = (
        {
            "version": VERSION,
            **_frame_as_json(frame),
            "friction": friction,
            "groups": {group: statistics(shape) for group, shape in shapes.items()},
        }
        | ({"codes": dict(codes)} if codes else {})
        | ({"sky_rgb": list(sky)} if sky else {})
    )
    _write(folder / TILE_FILE, body)
    write_scene_file(world, name, Frame(frame.crs, origin or frame.origin, frame.unit), [name], robot_map)
    return read_scene(world)


def write_scene_file(
    world: Path, name: str, frame: Frame, tiles: list[str], robot_map: RobotMapFrame | None = None
) -> None:
    """Write `scene.json` below `world`: name, origin and CRS (`frame`), names of the tiles, frame of a robot's map."""
    body = {"version": VERSION, "name": name, **_frame_as_json(frame), "tiles": tiles}
    if robot_map is not None:
        T = robot_map.T_world_map.copy()
        T[:3, 3] -= frame.origin
        body["robot_map"] = {"T_world_map": T.round(9).tolist(), "unit_m": robot_map.unit}
    _write(world / SCENE_FOLDER / SCENE_FILE, body)


def add_dome(scene: Scene, world: Path, make: Callable[[Scene, Path], None]) -> Scene:
    """Add the sky dome of all tiles to a scene that was saved below `world`; returns the scene with it.

    Args:
        scene: the scene.
        world: the world's folder.
        make: writes the dome into a folder, a textured mesh in metres from the scene's origin, or nothing.
    """
    folder = world / SCENE_FOLDER / DOME_FOLDER
    make(scene, folder / BACKDROP)
    if not (folder / BACKDROP).is_dir():
        return scene
    frame = scene.frame
    Mesh(frame, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).save(folder / COLLISION_FILE)
    _write(folder / TILE_FILE, {"version": VERSION, **_frame_as_json(frame), "friction": 0.0, "groups": {}})
    return read_scene(world)


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
        frame_of_map = body.get("robot_map")
        robot_map = frame_of_map and RobotMapFrame(np.array(frame_of_map["T_world_map"]), frame_of_map["unit_m"])
        dome = None
        if (folder / DOME_FOLDER).is_dir():
            dome = replace(_tile(folder / DOME_FOLDER, frame), name=f"{body['name']}_sky")
        return Scene(body["name"], frame, tiles, robot_map=robot_map, dome=dome)
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
    codes, sky = body.get("codes", {}), tuple(body["sky_rgb"]) if "sky_rgb" in body else None
    return SceneTile(folder.name, tile_frame, (x, y, z), body["friction"], body["groups"], folder, codes, sky)


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
