"""Join: fits the mesh's border to those of neighbouring tiles of a survey."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell

BLEND_DISTANCE_M = 0.5
"""Distance from the border over which the surface is blended to the new height."""


class JoinParams(Params):
    """How far a border may be moved to meet the neighbour's; of two tiles, the first by name keeps its border.

    Attributes:
        tolerance: maximum displacement of a vertex in metres; if the neighbour's border is farther away, it is kept.
    """

    tolerance: float = Field(0.3, ge=0.001, le=10)
    context: TileCell


def join(inputs: Inputs, params: JoinParams, out: Path, report: Report) -> Done:
    """Fit the border of the clipped `mesh` (`on`) to those of neighbours, `mesh.NAME` and `on.NAME`, if given.

    Neighbours whose names sort after the tile's name aren't needed: they fit their border to this tile.
    """
    from scan2sim.pipeline.tiling.borders.clip import Clipped
    from scan2sim.pipeline.tiling.borders.join import join as join_mesh

    clips = {params.context.name: Clipped.load(inputs["mesh"], inputs["on"])}
    for name in sorted(params.context.neighbours):
        if f"mesh.{name}" in inputs:
            clips[name] = Clipped.load(inputs[f"mesh.{name}"], inputs[f"on.{name}"])
    joined = join_mesh(params.context.name, clips, params.tolerance, BLEND_DISTANCE_M)
    joined.mesh.save(out / "mesh.npz")
    facts = {"faces_in": len(clips[params.context.name].mesh), "faces": len(joined.mesh), "turned": joined.turned}
    missing = sorted(name for name in params.context.neighbours if name < params.context.name and name not in clips)
    return Done({"mesh": out / "mesh.npz"}, facts | {"borders": joined.metrics, "missing": missing})


JOIN = Step("join", 1, join, JoinParams, per_class=True)
