"""Export: writes the world's folder in the requested formats (Gazebo with SDF, OBJ and Collada; GLB; others)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Coordinate, Name
from scan2sim.pipeline.core.step import Context, Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import I32
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, ROADS_FILE, save_tile

LISTS = {
    "plants": "plants.geojson", "plants_csv": "plants.csv",
    "furniture": "furniture.geojson", "furniture_csv": "furniture.csv", "instances": "instances.geojson",
    "roads": "roads.geojson", "roads_seen": ROADS_FILE, "path": PATH_FILE,
}  # fmt: skip  # input to file in the world's folder


def _pixel_size(size: bool | float) -> bool | float:
    if not (size in (False, True) or 0.001 <= size <= 100):
        raise ValueError("must be metres per pixel from 0.001 to 100, or true or false")
    return size


class ExportContext(Context):
    """Name of the tile, its world and its model."""

    name: Name = "tile"


class ExportParams(SceneParams):
    """Formats and contents of the world.

    Attributes:
        formats: modules of `pipeline/io/world_formats`; `scan2sim export` writes further formats later.
        friction: Coulomb friction coefficient of roads; 0.9 is rubber on dry asphalt. Other classes scale with it.
        world_origin: origin of the world in the CRS, metres; tiles with the same origin share their georeference.
            Default: the tile's own origin.
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
    `opendrive` (from step `roads`) are copied into it. With `views` and `choice.*`, the scene records for each face
    the photo that textures it.

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
    scene = save_tile(
        world,
        params.context.name,
        surfaces,
        inputs["collision"],
        lists,
        params.friction,
        params.world_origin,
        views,
        photos,
    )
    world_formats.write(scene, params.formats, world, params, report)
    for file in inputs["opendrive"].iterdir() if "opendrive" in inputs else ():
        shutil.copyfile(file, world / file.name)
    tile = scene.tiles[0]
    metrics = {
        "triangles": {group: figures["triangles"] for group, figures in tile.groups.items()},
        "pages": {group: figures["pages"] for group, figures in tile.groups.items()},
        "collision_triangles": len(tile.solid()),
        "bytes": sum({s.st_ino: s.st_size for s in (f.stat() for f in world.rglob("*") if f.is_file())}.values()),
    }
    return Done({"world": world}, metrics)


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


EXPORT = Step("export", 6, export, ExportParams, check=can_export)
