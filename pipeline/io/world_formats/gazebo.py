"""Gazebo: a world and a static model for each tile, in SDF; meshes in the formats of `export.meshes`.

Layout: `<name>.sdf`, and for each tile `models/<tile>/` with `model.sdf`, `model.config` and `meshes/`: one file per
class (a visual with its label), and the collision shapes (`collision_<class>.obj`; poles and trunks are cylinders).
Tiles of a survey are in separate levels, which the simulator loads on demand.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.plugins import find
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import GAZEBO_VISUAL_FORMATS, SceneParams
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile, by_class


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the models in local metres, z up, and the world that places them."""
    triangles: dict[str, int] = {}
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        written = _model(folder / "models" / tile.name, tile, params)
        triangles |= {f"models/{tile.name}/meshes/{file}": count for file, count in written.items()}
    world, georeference = folder / f"{scene.name}.sdf", sdf.Georeference.of(scene.frame)
    if len(scene.tiles) == 1:
        sdf.write_world(world, scene.tiles[0].name, georeference, scene.tiles[0].offset, scene.start)
    else:
        placed = [sdf.PlacedModel(tile.name, tile.offset, tile.low, tile.high) for tile in scene.tiles]
        sdf.write_levels(world, scene.name, georeference, placed, sdf.LEVEL_BUFFER_M, sdf.PERFORMER_NAME, scene.start)
    return triangles


def _model(folder: Path, tile: SceneTile, params: SceneParams) -> dict[str, int]:
    """Write a tile's model; returns the number of triangles of its mesh files."""
    formats = {name: find("scan2sim.pipeline.io.mesh_formats", name, "export.meshes") for name in params.meshes}
    visual_suffix = next(formats[name].SUFFIX for name in GAZEBO_VISUAL_FORMATS if name in formats)
    meshes = folder / "meshes"
    triangles: dict[str, int] = {}
    labels: dict[str, int] = {}
    for group, shape in tile.textured().items():
        names = world_formats.write_pages(meshes, group, shape, params)
        for surface in by_class(group, shape):
            for part in surface.parts(params.max_visual_triangles):
                for mesh_format in formats.values():
                    mesh_format.write(meshes / f"{part.name}{mesh_format.SUFFIX}", part.shape, names)
                    triangles[f"{part.name}{mesh_format.SUFFIX}"] = len(part.shape)
                labels[f"meshes/{part.name}{visual_suffix}"] = part.code
    solids, solid_triangles = world_formats.write_solids(meshes, tile)
    sdf.write_model(folder, tile.name, labels, solids)
    return triangles | solid_triangles
