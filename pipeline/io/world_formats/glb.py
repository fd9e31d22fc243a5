"""glTF: one GLB per tile, placed in the world, y up, with embedded textures; see `pipeline/io/worlds/glb.py`."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.scene import Scene


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write `<tile>.glb` for each tile, and `<name>_sky.glb` if a survey has a sky dome."""
    triangles = {}
    for i, tile in enumerate(scene.with_dome):
        report(i / len(scene.with_dome), tile.name)
        surfaces = [*tile.surfaces(), *tile.backdrop()]
        glb.write(folder / f"{tile.name}.glb", surfaces, params, views=tile.views(), offset=tile.offset)
        triangles[f"{tile.name}.glb"] = sum(len(surface.shape) for surface in surfaces)
    return triangles
