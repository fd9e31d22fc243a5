"""3D Gaussian splats: for each tile `<tile>.ply`, `<tile>.spz` (a tenth of its size) and `<tile>_splats.glb`.

PLY and SPZ are in world metres, z up; the GLB is y up, as that of the mesh, and has `KHR_gaussian_splatting`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import splat_files
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.gltf import splats as gltf
from scan2sim.pipeline.io.worlds.scene import Scene

NEEDS = splat_files.NEEDS


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the splats of all tiles that have some; they have no triangles.

    Raises:
        DataError: no tile has splats.
    """
    written = 0
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        layer = tile.splats()
        if layer is None:
            continue
        offset = np.asarray(tile.offset, float)
        for suffix in (".ply", ".spz"):
            splat_files.write(folder / f"{tile.name}{suffix}", layer.splats, offset)
        gltf.write(folder / f"{tile.name}_splats.glb", layer.splats, offset)
        written += 1
    if not written:
        raise DataError(
            "splats",
            f"{scene.name} has no splats",
            "Build it with photos from the ground, and without splats.when=never",
        )
    return {}
