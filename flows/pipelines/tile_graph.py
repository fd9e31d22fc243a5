"""Builder of a tile's task graph: adds tasks with the settings of their steps, and names their outputs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.core.types import Tile

Sources = dict[str, Path | Output]
"""Inputs of a task by name: source files and outputs of other tasks."""


class TileGraph:
    """The tasks of a tile that were added so far, and what is known of the tile before any of them runs.

    Attributes:
        tasks: tasks added so far.
        tile: the tile.
        settings: of all steps.
        cell: name, seed, neighbours and buffer of the tile's cell; empty if the tile isn't part of a survey.
        neighbours: names of the neighbouring tiles that are built, too.
        border_owners: those neighbours that own the border with this tile.
    """

    def __init__(
        self,
        tile: Tile,
        settings: Settings,
        survey_tiles: Collection[str] | None,
        side_products: Sequence[Step],
        without: Collection[TaskId],
    ) -> None:
        self.tasks: list[Task] = []
        self.tile, self.settings, self._without = tile, settings, without
        self._side_products = {step.name for step in side_products}
        self._name = "" if survey_tiles is None else tile.name
        self.cell: dict[str, Any] = {}
        if tile.cell:
            neighbours = dict(tile.cell.neighbours)
            self.cell = {
                "name": tile.name, "seed": tile.cell.seed, "neighbours": neighbours, "buffer": tile.cell.buffer,
            }  # fmt: skip
        self.neighbours = [name for name in self.cell.get("neighbours", {}) if name in (survey_tiles or ())]
        self.border_owners = [name for name in self.neighbours if name < tile.name]

    def params(self, step: Step, group: str = "") -> Any:
        """Settings of a step, without its context."""
        return self.settings.params(step, group)

    def is_enabled(self, step: Step, other: str | None = None) -> bool:
        """Whether a step of this tile, or of the neighbour `other`, is not among the failed side products."""
        return TaskId(step.name, tile=self._name if other is None else other) not in self._without

    def add(self, step: Step, inputs: Mapping[str, Path | Output], group: str = "", **context: Any) -> None:
        """Add a task, unless it is a side product that failed."""
        if self.is_enabled(step):
            params, side_product = self.settings.params(step, group, context), step.name in self._side_products
            self.tasks.append(Task(step, params, inputs, group, self._name, side_product))

    def output(self, step: Step, name: str, group: str = "", other: str | None = None) -> Output:
        """An output of a task of this tile, or of the neighbour `other`."""
        return Output(TaskId(step.name, group, self._name if other is None else other), name)

    def neighbour_outputs(self, step: Step, name: str, group: str = "", prefix: str | None = None) -> Sources:
        """An output of the tasks of all neighbours, as inputs `prefix.tile`; default prefix: the output's name."""
        tiles = [tile for tile in self.neighbours if self.is_enabled(step, tile)]
        return {f"{prefix or name}.{tile}": self.output(step, name, group, tile) for tile in tiles}
