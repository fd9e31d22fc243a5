"""Export: the world's folder, for Gazebo (SDF, OBJ, Collada) and everything else (GLB, and what is asked for)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.parameters import Coordinate, Name
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import I32
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import PATH, ROADS, keep

LISTS = {
    "plants": "plants.geojson", "plants_csv": "plants.csv",
    "furniture": "furniture.geojson", "furniture_csv": "furniture.csv", "things": "things.geojson",
    "roads": "roads.geojson", "roads_seen": ROADS, "path": PATH,
}  # fmt: skip  # input to file in the world's folder


def _pixel(size: bool | float) -> bool | float:
    if not (size in (False, True) or 0.001 <= size <= 100):
        raise ValueError("give metres a pixel from 0.001 to 100, or true or false")
    return size


class ExportParams(SceneParams):
    """What is written.

    Attributes:
        name: of the tile, its world and its model; set by the recipe.
        formats: files of `pipeline/io/world_formats`; `scan2sim export` writes others later.
        friction: Coulomb friction coefficient of roads; 0.9 is rubber on dry asphalt, and other classes follow.
        world_origin: metres in the CRS; several tiles with the same one share their georeference.
            Default: the tile's own origin.
        rasters: metres a pixel of an orthophoto, a DSM and a DTM as cloud-optimised GeoTIFF (the step `rasters`);
            true: as fine as the ground's texels.
    """

    name: Name = "tile"
    formats: tuple[str, ...] = Field(("gazebo", "glb"), json_schema_extra={"range": "a list of formats"})
    friction: float = Field(0.9, ge=0, le=10)
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    rasters: Annotated[bool | float, AfterValidator(_pixel)] = Field(
        False, json_schema_extra={"range": "true or false, or 0.001 to 100"}
    )


def export(inputs: Inputs, params: ExportParams, out: Path, report: Report) -> Done:
    """Write the textured groups and the collision mesh as a world.

    Below `world/` is what `pipeline.io.world_formats` writes of each of the formats, `metadata.json`, the lists that
    are
    given, and `scene/`, from which other formats can be written later (`pipeline.io.worlds.scene`). Meshes are in the
    tile's
    local metres; its place is in poses, nodes and the georeference alone. Files of the folder `opendrive` (of the step
    `roads`) are placed beside the formats. With `views` and `choice.*` the scene records for each face the photo
    that gives its detail.

    Raises:
        DataError: no group has a face.
        SettingError: there is no such format; Gazebo's world is wanted, but no mesh that it shows.
        UnavailableError: a format can't be written here.
        InputError: a textured mesh is incomplete, or in another frame than the others.
    """
    world_formats.check(params.formats, params, "export.formats")
    world = out / "world"
    views = views_io.load(inputs["views"]) if "views" in inputs else ()
    photos = {str(group): _details(inputs[f"choice.{group}"]) for group in SURFACES if f"choice.{group}" in inputs}
    surfaces = {str(group): inputs[group] for group in SURFACES if group in inputs}
    lists = {file: inputs[key] for key, file in LISTS.items() if key in inputs}
    scene = keep(
        world, params.name, surfaces, inputs["collision"], lists, params.friction, params.world_origin, views, photos
    )
    world_formats.write(scene, params.formats, world, params, report)
    for file in inputs["opendrive"].iterdir() if "opendrive" in inputs else ():
        shutil.copyfile(file, world / file.name)
    tile = scene.tiles[0]
    facts = {
        "triangles": {group: figures["triangles"] for group, figures in tile.groups.items()},
        "pages": {group: figures["pages"] for group, figures in tile.groups.items()},
        "collision_triangles": len(tile.solid()),
        "bytes": sum({s.st_ino: s.st_size for s in (f.stat() for f in world.rglob("*") if f.is_file())}.values()),
    }
    return Done({"world": world}, facts)


def _details(path: Path) -> I32:
    """(F,) of a choice (`texturing.view_selection.step`), which view gives each face its detail."""
    with np.load(path) as choice:
        return np.asarray(choice["label"], np.int32)


def can_export(params: ExportParams) -> None:
    """Refuse to begin if formats or rasters are wanted that can't be written here.

    Raises:
        SettingError: there is no such format.
        UnavailableError: a package isn't installed.
    """
    world_formats.check(params.formats, params, "export.formats")
    if params.rasters:
        need("export.rasters", "rasterio")


EXPORT = Step("export", 6, export, ExportParams, check=can_export)
