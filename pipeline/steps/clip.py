"""Clip: cuts the mesh to the tile's Voronoi cell where tiles of a survey meet."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh


class ClipParams(Params):
    """No settings: the mesh is cut to the tile's cell."""

    context: TileCell


def clip(inputs: Inputs, params: ClipParams, out: Path, report: Report) -> Done:
    """Cut `mesh` to the tile's cell; `on` records which vertices lie on which border."""
    from scan2sim.pipeline.tiling.borders.clip import clip as clip_mesh

    mesh = Mesh.load(inputs["mesh"])
    clipped = clip_mesh(mesh, params.context.cell)
    clipped.save(out / "mesh.npz", out / "on.npz")
    on = {name: int(flags.sum()) for name, flags in clipped.on.items()}
    metrics = {"faces_in": len(mesh), "faces": len(clipped.mesh), "on_border": on}
    return Done({"mesh": out / "mesh.npz", "on": out / "on.npz"}, metrics)


CLIP = Step("clip", 1, clip, ClipParams, per_class=True)
