"""Join: the mesh's border fitted to the neighbours', where tiles of a survey meet."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.steps.clip import CellParams


class JoinParams(CellParams):
    """How far a border may be moved to meet the neighbour's.

    Attributes:
        name: of the tile; set by the recipe, as the cell is. Of two tiles, the one whose name sorts first
            keeps its border.
        tolerance: metres that a vertex may be moved; where the neighbour has nothing that close, it stays.
        reach: metres behind the border over which the surface is brought to the new height.
    """

    name: str
    tolerance: float = Field(0.3, ge=0.001, le=10)
    reach: float = Field(0.5, ge=0.001, le=100)


def join(inputs: Inputs, params: JoinParams, out: Path, report: Report) -> Done:
    """Fit the border of the clipped `mesh` (`on`) to those of neighbours, `mesh.NAME` and `on.NAME`, where given.

    Neighbours whose names sort after the tile's own needn't be given: they fit theirs to this one.
    """
    from scan2sim.pipeline.tiling.borders.clip import Clipped
    from scan2sim.pipeline.tiling.borders.join import join as join_mesh

    clips = {params.name: Clipped.load(inputs["mesh"], inputs["on"])}
    for name in sorted(params.neighbours):
        if f"mesh.{name}" in inputs:
            clips[name] = Clipped.load(inputs[f"mesh.{name}"], inputs[f"on.{name}"])
    joined = join_mesh(params.name, clips, params.tolerance, params.reach)
    joined.mesh.save(out / "mesh.npz")
    facts = {"faces_in": len(clips[params.name].mesh), "faces": len(joined.mesh), "turned": joined.turned}
    missing = sorted(name for name in params.neighbours if name < params.name and name not in clips)
    return Done({"mesh": out / "mesh.npz"}, facts | {"borders": joined.facts, "missing": missing})


JOIN = Step("join", 1, join, JoinParams, per_class=True)
