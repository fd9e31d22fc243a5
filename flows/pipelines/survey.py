"""Pipeline definition of a survey: the task graph of several tiles with matching borders."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.types import Tile


def build_survey_graph(tiles: Sequence[Tile], settings: Settings, without: Collection[TaskId] = ()) -> list[Task]:
    """The task graph of several tiles of a survey, with matching borders.

    Each task comes after those that it reads, otherwise tile by tile, so that the first tiles are finished early.

    Args:
        tiles: the tiles to build.
        settings: of all steps.
        without: side products of any tile to leave out, because they failed.

    Raises:
        SettingError: as `tile.build_graph`.
    """
    names = [tile.name for tile in tiles]
    tasks = {task.id: task for tile in tiles for task in build_graph(tile, settings, names, without)}
    ordered: dict[TaskId, Task] = {}

    def add(task: Task) -> None:
        for source in task.inputs.values():
            if isinstance(source, Output) and source.task not in ordered:
                add(tasks[source.task])
        ordered.setdefault(task.id, task)

    for task in tasks.values():
        add(task)
    return list(ordered.values())
