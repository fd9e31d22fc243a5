"""Export: the world's folder, for Gazebo (SDF, OBJ, Collada) and everything else (GLB)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field

from scan2sim.pipeline.classes import SURFACES
from scan2sim.pipeline.errors import DataError, SettingError
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.ranges import Coordinate, Name
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step

if TYPE_CHECKING:
    from scan2sim.pipeline.io.textured import Textured
    from scan2sim.pipeline.types import Frame

LISTS = {
    "plants": "plants.geojson", "plants_csv": "plants.csv",
    "furniture": "furniture.geojson", "furniture_csv": "furniture.csv", "things": "things.geojson",
}  # fmt: skip  # input to file in the world's folder


def _pixel(size: bool | float) -> bool | float:
    if not (size in (False, True) or 0.001 <= size <= 100):
        raise ValueError("give metres a pixel from 0.001 to 100, or true or false")
    return size


class ExportParams(Params):
    """What is written.

    Attributes:
        name: of the tile, its world and its model; set by the recipe.
        obj, collada, glb, gazebo: formats; Gazebo's model shows the OBJ, which it reads several times
            faster than Collada, or Collada where OBJ is off.
        friction: Coulomb friction coefficient of the ground; 0.9 is rubber on dry asphalt.
        max_visual_triangles: of one OBJ or Collada file; larger groups are written in parts.
        pages: "png", lossless, or "jpeg", a sixth or so of its size, for the texture pages of OBJ and Collada.
        jpeg_quality: of the GLB's textures, and of JPEG pages.
        world_origin: metres in the CRS; several tiles with the same one share their georeference.
            Default: the tile's own origin.
        rasters: metres a pixel of an orthophoto, a DSM and a DTM as cloud-optimised GeoTIFF (the step `rasters`);
            true: as fine as the ground's texels.
    """

    name: Name = "tile"
    obj: bool = True
    collada: bool = True
    glb: bool = True
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
        SettingError: Gazebo's world is wanted, but neither OBJ nor Collada.
        InputError: a textured mesh is incomplete, or in another frame than the others.
    """
    import json
    import shutil

    from scan2sim.pipeline.io import gltf, obj, textured
    from scan2sim.pipeline.types import Mesh

    if params.gazebo and not (params.obj or params.collada):
        raise SettingError("export", "gazebo needs a mesh format", "Set export.obj=true or export.collada=true")
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
        written = _write_group(meshes, group, surface, params)
        counts |= written
        suffix = ".obj" if params.obj else ".dae"
        visuals |= {f"meshes/{file}": group for file in written if file.endswith(suffix)}
    obj.write_plain(meshes / "collision.obj", solid)
    counts["collision.obj"] = len(solid)
    for key, file in LISTS.items():
        if key in inputs:
            shutil.copyfile(inputs[key], world / file)
    if params.gazebo:
        _write_gazebo(world, model, visuals, frame, params)
    if params.glb:
        report(0.7, "GLB")
        gltf.write(world / f"{params.name}.glb", surfaces, params.jpeg_quality)
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
    from scan2sim.pipeline.errors import InputError

    frame: Frame = solid.frame
    for group, surface in surfaces.items():
        if surface.mesh.frame != frame:
            raise InputError(
                inputs[group],
                f"has the origin {surface.mesh.frame.origin}, the collision mesh {frame.origin}",
                "Make all meshes of a tile from the same ingested cloud",
            )
    return frame


def _write_group(folder: Path, group: str, surface: Textured, params: ExportParams) -> dict[str, int]:
    """Write a group's OBJ and Collada files and their images; triangles of every mesh file."""
    import shutil

    from scan2sim.pipeline.io import collada, image, obj

    if not (params.obj or params.collada):
        return {}
    materials = [f"{group}_{page}" for page in range(len(surface.pages))]
    images = [f"{name}.{'png' if params.pages == 'png' else 'jpg'}" for name in materials]
    for page in surface.used_pages:
        if params.pages == "png":
            shutil.copyfile(surface.pages[page], folder / images[page])
        else:
            image.copy(surface.pages[page], folder / images[page], quality=params.jpeg_quality)
    if params.obj:
        obj.write_mtl(folder / f"{group}.mtl", {materials[p]: images[p] for p in surface.used_pages})
    counts = {}
    parts = surface.parts(params.max_visual_triangles)
    for i, part in enumerate(parts, start=1):
        stem = group if len(parts) == 1 else f"{group}_part{i}"
        if params.obj:
            obj.write(folder / f"{stem}.obj", part, materials, f"{group}.mtl")
            counts[f"{stem}.obj"] = len(part)
        if params.collada:
            collada.write(folder / f"{stem}.dae", part, materials, images)
            counts[f"{stem}.dae"] = len(part)
    return counts


def _write_gazebo(world: Path, model: Path, visuals: dict[str, str], frame: Frame, params: ExportParams) -> None:
    from scan2sim.pipeline.io import sdf
    from scan2sim.pipeline.types import Frame

    origin = params.world_origin or frame.origin
    x, y, z = (here - there for here, there in zip(frame.origin, origin, strict=True))
    place = sdf.Georeference.of(Frame(frame.crs, origin, frame.unit))
    sdf.write_world(world / f"{params.name}.sdf", params.name, place, (x, y, z))
    sdf.write_model(model, params.name, visuals, "meshes/collision.obj", params.friction)


def _metadata(
    params: ExportParams, frame: Frame, surfaces: dict[str, Textured], files: dict[str, int]
) -> dict[str, Any]:
    """What a reader needs to put the meshes back on the map, and to check that they are whole."""
    import numpy as np

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
    """Refuse to begin if rasters are wanted without what writes them.

    Raises:
        UnavailableError: rasterio isn't installed.
    """
    if params.rasters:
        need("export.rasters", "rasterio")


EXPORT = Step("export", 2, export, ExportParams, check=can_export)
