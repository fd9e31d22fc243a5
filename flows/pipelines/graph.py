"""What graphs of steps are made of: nodes, and outputs of nodes as inputs of others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.step import Params, Step


@dataclass(frozen=True, order=True)
class NodeId:
    """Which node of a graph.

    Attributes:
        step: name of the step.
        group: the class that it is run for, of a step that is run per class.
        tile: of a survey; "" where one tile is made for itself.
    """

    step: str
    group: str = ""
    tile: str = ""

    @property
    def name(self) -> str:
        """Within the tile: `poisson.terrain`."""
        return f"{self.step}.{self.group}" if self.group else self.step

    @property
    def full_name(self) -> str:
        """On screens, and as the folder in the store: `street_0001/poisson.terrain`."""
        return f"{self.tile}/{self.name}" if self.tile else self.name

    def __str__(self) -> str:
        return self.full_name


@dataclass(frozen=True)
class Output:
    """An output of a node, as another's input."""

    node: NodeId
    name: str


@dataclass(frozen=True)
class Node:
    """A step to be run.

    Attributes:
        step, params: what is run.
        inputs: name to a source file, or to another node's output.
        group, tile: as of its id.
    """

    step: Step
    params: Params
    inputs: Mapping[str, Path | Output]
    group: str = ""
    tile: str = ""

    @property
    def id(self) -> NodeId:
        """By which others name it; unique in the graph."""
        return NodeId(self.step.name, self.group, self.tile)

    @property
    def full_name(self) -> str:
        """As `NodeId.full_name`."""
        return self.id.full_name


def needed(nodes: Sequence[Node], wanted: Iterable[NodeId]) -> list[Node]:
    """The nodes that these need, and themselves, in order."""
    found = set(wanted)
    for node in reversed(nodes):
        if node.id in found:
            found |= {source.node for source in node.inputs.values() if isinstance(source, Output)}
    return [node for node in nodes if node.id in found]
