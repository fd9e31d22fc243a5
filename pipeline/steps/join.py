"""Join: fits the mesh's border to those of neighbouring tiles of a survey."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.tiling.cell_params import CellParams


class JoinParams(CellParams):
    """How far a border may be moved to meet the neighbour's.

    Attributes:
        name: name of the tile; set by the pipeline, as the cell is. Of two tiles, the one whose name sorts first
            keeps its border.
        tolerance: maximum displacement of a vertex in metres; if the neighbour's border is farther away, it is kept.
        blend_distance: distance from the border in metres over which the surface is blended to the new height.
    """

    name: str
    tolerance: float = Field(0.3, ge=0.001, le=10)
    blend_distance: float = Field(0.5, ge=0.001, le=100)


def join(inputs: Inputs, params: JoinParams, out: Path, report: Report) -> Done:
    """Fit the border of the clipped `mesh` (`on`) to those of neighbours, `mesh.NAME` and `on.NAME`, if given.

    Neighbours whose names sort after the tile's name aren't needed: they fit their border to this tile.
    """
    from scan2sim.pipeline.tiling.borders.clip import Clipped
    from scan2sim.pipeline.tiling.borders.join import join as join_mesh

    clips = {params.name: Clipped.load(inputs["mesh"], inputs["on"])}
    for name in sorted(params.neighbours):
        if f"mesh.{name}" in inputs:
            clips[name] = Clipped.load(inputs[f"mesh.{name}"], inputs[f"on.{name}"])
    joined = join_mesh(params.name, clips, params.tolerance, params.blend_distance)
    joined.mesh.save(out / "mesh.npz")
    facts = {"faces_in": len(clips[params.name].mesh), "faces": len(joined.mesh), "turned": joined.turned}
    missing = sorted(name for name in params.neighbours if name < params.name and name not in clips)
    return Done({"mesh": out / "mesh.npz"}, facts | {"borders": joined.metrics, "missing": missing})


JOIN = Step("join", 1, join, JoinParams, per_class=True)
