"""3D Gaussian splats: for each tile `<tile>.ply`, `<tile>.spz` (a seventh of its size) and `<tile>_splats.glb`.

PLY is in world metres, z up; SPZ and the GLB, which has `KHR_gaussian_splatting`, are y up, as the GLB of the mesh. The
background is a shell of large splats (`SplatLayer.with_shell`), unless there are several tiles: their shells would hide
each other's streets.
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
        whole = layer.with_shell() if len(scene.tiles) == 1 else layer.splats
        splat_files.write(folder / f"{tile.name}.ply", whole, offset)
        splat_files.write(folder / f"{tile.name}.spz", whole.y_up(), offset[[0, 2, 1]] * (1, 1, -1))
        gltf.write(folder / f"{tile.name}_splats.glb", whole, offset)
        written += 1
    if not written:
        raise without_splats(scene)
    return {}


def without_splats(scene: Scene) -> DataError:
    """The error of a scene none of whose tiles has splats."""
    return DataError(
        "splats",
        f"{scene.name} has no splats",
        "Run it again with --set splats.when=auto; this needs at least two photos other than orthophotos",
    )
