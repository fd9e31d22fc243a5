"""Clip: cuts the mesh to the tile's Voronoi cell where tiles of a survey meet."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.parameters import PlanPoint
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.tiling.voronoi_cell import Cell


class CellParams(Params):
    """The tile's Voronoi cell within the survey, set by the pipeline.

    Attributes:
        seed: (x, y) world metres (CRS coordinates times metres per unit).
        neighbours: seeds of the tiles with adjacent cells, by name, world metres.
    """

    seed: PlanPoint
    neighbours: dict[str, PlanPoint] = Field(default_factory=dict)

    @property
    def cell(self) -> Cell:
        """The tile's cell."""
        return Cell(self.seed, self.neighbours)


def clip(inputs: Inputs, params: CellParams, out: Path, report: Report) -> Done:
    """Cut `mesh` to the tile's cell; `on` records which vertices lie on which border."""
    from scan2sim.pipeline.tiling.borders.clip import clip as clip_mesh

    mesh = Mesh.load(inputs["mesh"])
    clipped = clip_mesh(mesh, params.cell)
    clipped.save(out / "mesh.npz", out / "on.npz")
    on = {name: int(flags.sum()) for name, flags in clipped.on.items()}
    facts = {"faces_in": len(mesh), "faces": len(clipped.mesh), "on_border": on}
    return Done({"mesh": out / "mesh.npz", "on": out / "on.npz"}, facts)


CLIP = Step("clip", 1, clip, CellParams, per_class=True)
