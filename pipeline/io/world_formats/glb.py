"""glTF: one GLB per tile, placed in the world, y up, with embedded textures; see `pipeline/io/worlds/glb.py`."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.scene import Scene


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write `<tile>.glb` for each tile."""
    triangles = {}
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        surfaces = tile.surfaces()
        glb.write(folder / f"{tile.name}.glb", surfaces, params, views=tile.views(), offset=tile.offset)
        triangles[f"{tile.name}.glb"] = sum(len(surface.shape) for surface in surfaces)
    return triangles
