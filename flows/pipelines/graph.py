"""Task graph (DAG): a task runs a step; its inputs are files and outputs of other tasks."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.step import Params, Step


@dataclass(frozen=True, order=True)
class TaskId:
    """Identifies a task of a graph.

    Attributes:
        step: name of the step.
        group: surface class that a per-class step is run for, else "".
        tile: name of the survey's tile; "" for a single tile.
    """

    step: str
    group: str = ""
    tile: str = ""

    @property
    def name(self) -> str:
        """Name within the tile: `poisson.terrain`."""
        return f"{self.step}.{self.group}" if self.group else self.step

    @property
    def full_name(self) -> str:
        """Name in messages, and of the folder in the store: `street_0001/poisson.terrain`."""
        return f"{self.tile}/{self.name}" if self.tile else self.name

    def __str__(self) -> str:
        return self.full_name


@dataclass(frozen=True)
class Output:
    """An output of a task, as an input of another one."""

    task: TaskId
    name: str


@dataclass(frozen=True)
class Task:
    """A step to run with its parameters and inputs.

    Attributes:
        step, params: the step and its parameters.
        inputs: input name to a source file, or to the output of another task.
        group, tile: as in its `TaskId`.
        side_product: whether the world is finished without its result if it fails.
    """

    step: Step
    params: Params
    inputs: Mapping[str, Path | Output]
    group: str = ""
    tile: str = ""
    side_product: bool = False

    @property
    def id(self) -> TaskId:
        """Id of the task, unique in the graph."""
        return TaskId(self.step.name, self.group, self.tile)

    @property
    def full_name(self) -> str:
        """As `TaskId.full_name`."""
        return self.id.full_name


def folder_inputs(name: str, folder: Path) -> dict[str, Path]:
    """A folder and those below it as inputs of a task: the digest of a folder is that of the files in it only."""
    below = sorted(Path(one) for one, _, _ in os.walk(folder) if Path(one) != folder)
    return {name: folder} | {f"{name}/{one.relative_to(folder).as_posix()}": one for one in below}


def source_paths(tasks: Iterable[Task]) -> set[Path]:
    """The source files and folders that tasks read."""
    return {source for task in tasks for source in task.inputs.values() if not isinstance(source, Output)}


def required_tasks(tasks: Sequence[Task], wanted: Iterable[TaskId]) -> list[Task]:
    """The wanted tasks and all tasks that they depend on, in order."""
    found = set(wanted)
    for task in reversed(tasks):
        if task.id in found:
            found |= {source.task for source in task.inputs.values() if isinstance(source, Output)}
    return [task for task in tasks if task.id in found]
