"""Parameters of the steps that need the tile's Voronoi cell."""

from __future__ import annotations

from pydantic import Field

from scan2sim.pipeline.core.parameters import PlanPoint
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.voronoi_cell import Cell


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
