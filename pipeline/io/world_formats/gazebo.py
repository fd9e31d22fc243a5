"""Gazebo: a world and a static model for each tile, in SDF; meshes in the formats of `export.meshes`.

Layout: `<name>.sdf`, and for each tile `models/<tile>/` with `model.sdf`, `model.config` and `meshes/`: a file a class
(a visual with its label), and of what bodies collide with (`collision_<class>.obj`; poles and trunks are cylinders).
Tiles of a survey are in levels that a simulator loads by itself.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.plugins import find
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SHOWN, SceneParams
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile, by_class


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the models, local metres and z up, and the world that places them."""
    triangles: dict[str, int] = {}
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        written = _model(folder / "models" / tile.name, tile, params)
        triangles |= {f"models/{tile.name}/meshes/{file}": count for file, count in written.items()}
    world, place = folder / f"{scene.name}.sdf", sdf.Georeference.of(scene.frame)
    if len(scene.tiles) == 1:
        sdf.write_world(world, scene.tiles[0].name, place, scene.tiles[0].offset, scene.start)
    else:
        placed = [sdf.Placed(tile.name, tile.offset, tile.low, tile.high) for tile in scene.tiles]
        sdf.write_levels(world, scene.name, place, placed, sdf.BUFFER, sdf.PERFORMER, scene.start)
    return triangles


def _model(folder: Path, tile: SceneTile, params: SceneParams) -> dict[str, int]:
    """A tile's model; triangles of its mesh files."""
    formats = {name: find("scan2sim.pipeline.io.mesh_formats", name, "export.meshes") for name in params.meshes}
    shown = next(formats[name].SUFFIX for name in SHOWN if name in formats)
    meshes = folder / "meshes"
    triangles: dict[str, int] = {}
    labels: dict[str, int] = {}
    for group, shape in tile.textured().items():
        names = world_formats.write_pages(meshes, group, shape, params)
        for surface in by_class(group, shape):
            for part in surface.parts(params.max_visual_triangles):
                for form in formats.values():
                    form.write(meshes / f"{part.name}{form.SUFFIX}", part.shape, names)
                    triangles[f"{part.name}{form.SUFFIX}"] = len(part.shape)
                labels[f"meshes/{part.name}{shown}"] = part.code
    solids, touched = world_formats.write_solids(meshes, tile)
    sdf.write_model(folder, tile.name, labels, solids)
    return triangles | touched
