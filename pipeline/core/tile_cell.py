"""Contexts that several steps share: the tile's Voronoi cell, and the thinned cloud."""

from __future__ import annotations

from pydantic import Field

from scan2sim.pipeline.core.parameters import Buffer, PlanPoint, Voxel
from scan2sim.pipeline.core.step import Context
from scan2sim.pipeline.core.voronoi_cell import Cell


class TileCell(Context):
    """A tile and its Voronoi cell within the survey.

    Attributes:
        name: name of the tile.
        seed: (x, y) world metres (CRS coordinates times metres per unit).
        neighbours: seeds of the tiles with adjacent cells, by name, world metres.
        buffer: distance in metres by which the tile's cloud extends beyond its cell.
    """

    name: str
    seed: PlanPoint
    neighbours: dict[str, PlanPoint] = Field(default_factory=dict)
    buffer: Buffer = 5.0

    @property
    def cell(self) -> Cell:
        """The tile's cell."""
        return Cell(self.seed, self.neighbours)


class ThinnedCloud(Context):
    """The thinned cloud of a class.

    Attributes:
        voxel: voxel size in metres (setting of step `voxel`).
        cell: the tile's cell, if it has neighbours.
    """

    voxel: Voxel = 0.10
    cell: TileCell | None = None
