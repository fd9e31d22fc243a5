"""Export: the world's folder, for Gazebo (SDF, OBJ, Collada) and everything else (GLB)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.backends import find
from scan2sim.pipeline.classes import SURFACES
from scan2sim.pipeline.errors import DataError, InputError, SettingError
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.io import image
from scan2sim.pipeline.ranges import Coordinate, Name
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.types import Frame, Mesh

if TYPE_CHECKING:
    from scan2sim.pipeline.io.textured import Textured

LISTS = {
    "plants": "plants.geojson", "plants_csv": "plants.csv",
    "furniture": "furniture.geojson", "furniture_csv": "furniture.csv", "things": "things.geojson",
}  # fmt: skip  # input to file in the world's folder


SHOWN = ("obj", "collada")
"""Formats that Gazebo's model shows, the better one first."""


def _pixel(size: bool | float) -> bool | float:
    if not (size in (False, True) or 0.001 <= size <= 100):
        raise ValueError("give metres a pixel from 0.001 to 100, or true or false")
    return size


class ExportParams(Params):
    """What is written.

    Attributes:
        name: of the tile, its world and its model; set by the recipe.
        formats: of meshes, files of `pipeline/io/meshes`.
        gazebo: whether to make a world for it; its model shows the OBJ, which it reads several times faster than
            Collada, or Collada where there is no OBJ.
        friction: Coulomb friction coefficient of the ground; 0.9 is rubber on dry asphalt.
        max_visual_triangles: of one file of the model; larger groups are written in parts.
        pages: "png", lossless, or "jpeg", a sixth or so of its size, for the texture pages of OBJ and Collada.
        jpeg_quality: of the GLB's textures, and of JPEG pages.
        world_origin: metres in the CRS; several tiles with the same one share their georeference.
            Default: the tile's own origin.
        rasters: metres a pixel of an orthophoto, a DSM and a DTM as cloud-optimised GeoTIFF (the step `rasters`);
            true: as fine as the ground's texels.
    """

    name: Name = "tile"
    formats: tuple[str, ...] = Field(("obj", "collada", "glb"), json_schema_extra={"range": "a list of formats"})
    gazebo: bool = True
    friction: float = Field(0.9, ge=0, le=10)
    max_visual_triangles: int = Field(200_000, ge=1_000, le=10_000_000)
    pages: Literal["png", "jpeg"] = "png"
    jpeg_quality: int = Field(90, ge=1, le=100)
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    rasters: Annotated[bool | float, AfterValidator(_pixel)] = Field(
        False, json_schema_extra={"range": "true or false, or 0.001 to 100"}
    )


def export(inputs: Inputs, params: ExportParams, out: Path, report: Report) -> Done:
    """Write the textured groups and the collision mesh as a world.

    Layout below `world/`: `<name>.sdf`, `<name>.glb`, `metadata.json`, and `models/<name>/` with
    `model.sdf`, `model.config` and `meshes/` (OBJ, MTL, Collada, one PNG or JPEG for every texture page, and
    `collision.obj`). Lists (`plants`, `furniture`, these as `_csv`, and `things`) that are given are put beside it.
    OBJ and Collada are z-up in the tile's local metres; the tile's place is in the
    world's pose and `spherical_coordinates` and in `metadata.json` alone.

    Raises:
        DataError: no group has a face.
        SettingError: there is no such format; Gazebo's world is wanted, but no mesh that it shows.
        UnavailableError: a format can't be written here.
        InputError: a textured mesh is incomplete, or in another frame than the others.
    """
    from scan2sim.pipeline.io import textured
    from scan2sim.pipeline.io.meshes import obj

    formats = _formats(params)
    shown = next((formats[name].SUFFIX for name in SHOWN if name in formats), None)
    if params.gazebo and shown is None:
        raise SettingError("export.formats", f"has nothing that Gazebo shows ({' or '.join(SHOWN)})", "Name one, too")
    read = {group: textured.read(inputs[group]) for group in SURFACES if group in inputs}
    surfaces: dict[str, Textured] = {group: surface for group, surface in read.items() if surface is not None}
    if not surfaces:
        raise DataError("export", "there is nothing to show: every surface is empty", "Check the classes of the cloud")
    solid = Mesh.load(inputs["collision"])
    frame = _common_frame(inputs, surfaces, solid)

    world = out / "world"
    model = world / "models" / params.name
    meshes = model / "meshes"
    meshes.mkdir(parents=True)
    counts: dict[str, int] = {}  # triangles of every mesh file, by its name
    visuals: dict[str, str] = {}
    for i, (group, surface) in enumerate(surfaces.items()):
        report(0.6 * i / len(surfaces), group)
        written = _write_group(meshes, group, surface, params, formats.values())
        counts |= written
        visuals |= {f"meshes/{file}": group for file in written if Path(file).suffix == shown}
    obj.write_plain(meshes / "collision.obj", solid)
    counts["collision.obj"] = len(solid)
    for key, file in LISTS.items():
        if key in inputs:
            shutil.copyfile(inputs[key], world / file)
    if params.gazebo:
        _write_gazebo(world, model, visuals, frame, params)
    report(0.7, "world")
    for form in formats.values():
        if hasattr(form, "write_world"):
            form.write_world(world / f"{params.name}{form.SUFFIX}", surfaces, params.jpeg_quality)
    metadata = _metadata(params, frame, surfaces, {f"models/{params.name}/meshes/{f}": n for f, n in counts.items()})
    (world / "metadata.json").write_text(json.dumps(metadata, indent=2) + "\n", encoding="utf-8")
    facts = {
        "triangles": {group: len(surface) for group, surface in surfaces.items()},
        "pages": {group: len(surface.pages) for group, surface in surfaces.items()},
        "collision_triangles": len(solid),
        "bytes": sum(file.stat().st_size for file in world.rglob("*") if file.is_file()),
    }
    return Done({"world": world}, facts)


def _common_frame(inputs: Inputs, surfaces: dict[str, Textured], solid: Any) -> Frame:
    """The frame of all meshes, which must be one."""
    frame: Frame = solid.frame
    for group, surface in surfaces.items():
        if surface.mesh.frame != frame:
            raise InputError(
                inputs[group],
                f"has the origin {surface.mesh.frame.origin}, the collision mesh {frame.origin}",
                "Make all meshes of a tile from the same ingested cloud",
            )
    return frame


def _formats(params: ExportParams) -> dict[str, Any]:
    """The modules of the formats that are wanted, by name.

    Raises:
        SettingError: there is no such format. UnavailableError: one can't be written here.
    """
    return {name: find("scan2sim.pipeline.io.meshes", name, "export.formats") for name in params.formats}


def _write_group(
    folder: Path, group: str, surface: Textured, params: ExportParams, formats: Iterable[Any]
) -> dict[str, int]:
    """Write a group's files in the formats that have some for each, and their images; triangles of every mesh file."""
    from scan2sim.pipeline.io.meshes import PageNames

    formats = [form for form in formats if hasattr(form, "write")]
    if not formats:
        return {}
    materials = tuple(f"{group}_{page}" for page in range(len(surface.pages)))
    images = tuple(f"{name}.{'png' if params.pages == 'png' else 'jpg'}" for name in materials)
    for page in surface.used_pages:
        if params.pages == "png":
            shutil.copyfile(surface.pages[page], folder / images[page])
        else:
            image.write(folder / images[page], image.read_rgb(surface.pages[page]), quality=params.jpeg_quality)
    names = PageNames(group, materials, images, tuple(surface.used_pages))
    counts = {}
    parts = surface.parts(params.max_visual_triangles)
    for i, part in enumerate(parts, start=1):
        stem = group if len(parts) == 1 else f"{group}_part{i}"
        for form in formats:
            form.write(folder / f"{stem}{form.SUFFIX}", part, names)
            counts[f"{stem}{form.SUFFIX}"] = len(part)
    return counts


def _write_gazebo(world: Path, model: Path, visuals: dict[str, str], frame: Frame, params: ExportParams) -> None:
    from scan2sim.pipeline.io import sdf

    origin = params.world_origin or frame.origin
    x, y, z = (here - there for here, there in zip(frame.origin, origin, strict=True))
    place = sdf.Georeference.of(Frame(frame.crs, origin, frame.unit))
    sdf.write_world(world / f"{params.name}.sdf", params.name, place, (x, y, z))
    sdf.write_model(model, params.name, visuals, "meshes/collision.obj", params.friction)


def _metadata(
    params: ExportParams, frame: Frame, surfaces: dict[str, Textured], files: dict[str, int]
) -> dict[str, Any]:
    """What a reader needs to put the meshes back on the map, and to check that they are whole."""
    from scan2sim.pipeline.io import sdf

    place = sdf.Georeference.of(frame)
    return {
        "name": params.name,
        "crs": frame.crs,
        "origin_m": list(frame.origin),
        "unit_m": frame.unit,
        "to_crs": "crs = (local + origin_m) / unit_m; OBJ and Collada are local, z-up; GLB is local, y-up (x, z, -y)",
        "world_origin_m": list(params.world_origin or frame.origin),
        "wgs84": place and place.facts(),
        "groups": {
            group: {
                "triangles": len(surface),
                "vertices": len(surface.mesh.vertices),
                "pages": len(surface.used_pages),
                "low_m": np.round(surface.mesh.vertices.min(axis=0).astype(float), 3).tolist(),
                "high_m": np.round(surface.mesh.vertices.max(axis=0).astype(float), 3).tolist(),
            }
            for group, surface in surfaces.items()
        },
        "friction": params.friction,
        "triangles_by_file": files,
    }


def can_export(params: ExportParams) -> None:
    """Refuse to begin if formats or rasters are wanted that can't be written here.

    Raises:
        SettingError: there is no such format.
        UnavailableError: a package isn't installed.
    """
    _formats(params)
    if params.rasters:
        need("export.rasters", "rasterio")


EXPORT = Step("export", 2, export, ExportParams, check=can_export)
