"""glTF: a GLB for each tile, in its place in the world, y-up, textures within; see `pipeline/io/glb.py`."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.io import glb
from scan2sim.pipeline.io.scene import Scene
from scan2sim.pipeline.io.scenes import SceneParams
from scan2sim.pipeline.step import Report


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write `<tile>.glb` for each tile."""
    triangles = {}
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        surfaces = tile.surfaces()
        glb.write(folder / f"{tile.name}.glb", surfaces, params, views=tile.views(), offset=tile.offset)
        triangles[f"{tile.name}.glb"] = sum(len(surface.shape) for surface in surfaces)
    return triangles
