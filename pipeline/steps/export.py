"""Export: writes the world's folder in the requested formats (Gazebo with SDF, OBJ and Collada; GLB; others)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.classes import CODE_OF_ROOMS, SURFACES
from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Coordinate, Name
from scan2sim.pipeline.core.step import Context, Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import I32
from scan2sim.pipeline.io import sky, world_formats
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, ROADS_FILE, SPLATS_FILE, TRACKS_FILE, RobotMapFrame, save_tile
from scan2sim.pipeline.simulation import ground_origin

LISTS = {
    "plants": "plants.geojson", "plants_csv": "plants.csv",
    "furniture_geojson": "furniture.geojson", "furniture_csv": "furniture.csv", "instances": "instances.geojson",
    "ghosts": "ghosts.geojson", "roads": "roads.geojson", "roads_seen": ROADS_FILE, "path": PATH_FILE,
    "tracks": TRACKS_FILE, "tracks_geojson": "tracks.geojson", "tracks_kitti": "tracks_kitti.txt",
    "tracks_nuscenes": "tracks_nuscenes.json", "floor": "floor.npz", "rooms": "rooms.geojson", "splats": SPLATS_FILE,
}  # fmt: skip  # input to file in the world's folder


Row = tuple[float, float, float, float]


def _pixel_size(size: bool | float) -> bool | float:
    if not (size in (False, True) or 0.001 <= size <= 100):
        raise ValueError("must be metres per pixel from 0.001 to 100, or true or false")
    return size


class ExportContext(Context):
    """The tile.

    Attributes:
        name: name of the tile, its world and its model.
        world_origin: origin of the world in the CRS, metres; None: that of the input `origin`, or else the tile's own.
        T_world_map: rigid transform from the robot's map, in metres, to the CRS; None: not made from a robot's map.
        unit: metres per unit of the robot's map.
        indoor: whether it shows rooms: the ground is floor, buildings are walls.
    """

    name: Name = "tile"
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    T_world_map: tuple[Row, Row, Row, Row] | None = None
    unit: float = 1.0
    indoor: bool = False


class ExportParams(SceneParams):
    """Formats and contents of the world.

    Attributes:
        formats: modules of `pipeline/io/world_formats`; `scan2sim export` writes further formats later.
        friction: Coulomb friction coefficient of roads; 0.9 is rubber on dry asphalt. Other classes scale with it.
        world_origin: origin of the world in the CRS, metres; tiles with the same origin share their georeference.
            Default: the ground in the middle of the tile; the world of a local robot's map keeps the map's coordinates.
        rasters: pixel size in metres of an orthophoto, a DSM and a DTM as cloud-optimized GeoTIFF (step `rasters`);
            true: texel size of the ground's texture.
    """

    formats: tuple[str, ...] = Field(("gazebo", "glb"), json_schema_extra={"range": "a list of formats"})
    friction: float = Field(0.9, ge=0, le=10)
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    rasters: Annotated[bool | float, AfterValidator(_pixel_size)] = Field(
        False, json_schema_extra={"range": "true or false, or 0.001 to 100"}
    )
    context: ExportContext = ExportContext()


def export(inputs: Inputs, params: ExportParams, out: Path, report: Report) -> Done:
    """Write the textured groups and the collision mesh as a world.

    The folder `world/` contains the files of each format (`pipeline.io.world_formats`), `metadata.json`, the given
    lists, and `scene/`, from which other formats can be written later (`pipeline.io.worlds.scene`). Meshes are in the
    tile's local metres; the tile's position is only in poses, nodes and the georeference. Files of the folder
    `opendrive` (from step `roads`) and `navigation` are copied into it. With `views` and `choice.*`, the scene records
    for each face the photo that textures it, and with `reflectance` the reflectance of each vertex. `sky` is the colour
    of the background (step `sky_colour`), `backdrop` what only cameras see (step `backdrop`). If an optional part
    fails (`world_formats.write`), the rest is written.

    Raises:
        DataError: no group has a face.
        SettingError: unknown format, or Gazebo's world without a mesh format that Gazebo reads.
        UnavailableError: a format requires a package that is not installed.
        InputError: a textured mesh is incomplete, or its frame differs from the others.
    """
    world_formats.check(params.formats, params, "export.formats")
    world = out / "world"
    views = views_io.load(inputs["views"]) if "views" in inputs else ()
    photos = {
        str(group): _label_of_face(inputs[f"choice.{group}"]) for group in SURFACES if f"choice.{group}" in inputs
    }
    surfaces = {str(group): inputs[group] for group in SURFACES if group in inputs}
    lists = {file: inputs[key] for key, file in LISTS.items() if key in inputs}
    lists |= {file.name: file for file in inputs["navigation"].iterdir()} if "navigation" in inputs else {}
    context = params.context
    robot_map = None if context.T_world_map is None else RobotMapFrame(np.array(context.T_world_map), context.unit)
    scene = save_tile(
        world,
        params.context.name,
        surfaces,
        inputs["collision"],
        lists,
        params.friction,
        params.world_origin or context.world_origin or ground_origin.read(inputs),
        views,
        photos,
        robot_map,
        CODE_OF_ROOMS if context.indoor else {},
        inputs.get("reflectance"),
        sky.read(inputs.get("sky")),
        inputs.get("backdrop"),
    )
    failed: dict[str, ScanError] = {}
    world_formats.write(scene, params.formats, world, params, report, failed=failed)
    for file in inputs["opendrive"].iterdir() if "opendrive" in inputs else ():
        shutil.copyfile(file, world / file.name)
    tile = scene.tiles[0]
    metrics = {
        "triangles": {group: figures["triangles"] for group, figures in tile.groups.items()},
        "pages": {group: figures["pages"] for group, figures in tile.groups.items()},
        "backdrop_triangles": sum(len(surface.shape) for surface in tile.backdrop() if params.backdrop),
        "collision_triangles": len(tile.solid()),
        "bytes": sum({s.st_ino: s.st_size for s in (f.stat() for f in world.rglob("*") if f.is_file())}.values()),
    }
    return Done({"world": world}, metrics, failed=failed)


def _label_of_face(path: Path) -> I32:
    """Index (F,) of the view that textures each face, from the result of view selection (`choice.*`)."""
    with np.load(path) as choice:
        return np.asarray(choice["label"], np.int32)


def can_export(params: ExportParams) -> None:
    """Check that the requested formats and rasters can be written on this machine.

    Raises:
        SettingError: unknown format.
        UnavailableError: a package isn't installed.
    """
    world_formats.check(params.formats, params, "export.formats")
    if params.rasters:
        require("export.rasters", "rasterio")


EXPORT = Step("export", 12, export, ExportParams, check=can_export)
