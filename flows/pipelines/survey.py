"""The graph of several tiles of a survey, which meet."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import recipe
from scan2sim.pipeline.core.types import Tile


def survey_recipe(tiles: Sequence[Tile], settings: Settings, without: Collection[NodeId] = ()) -> list[Node]:
    """The graph of several tiles of a survey, which meet.

    Each node comes after those that it reads; else tile after tile, so that the first are finished early.

    Args:
        tiles: to be made.
        settings: of all steps.
        without: side products that failed, of any tile.

    Raises:
        SettingError: as `recipe`.
    """
    names = [tile.name for tile in tiles]
    nodes = {node.id: node for tile in tiles for node in recipe(tile, settings, names, without)}
    ordered: dict[NodeId, Node] = {}

    def add(node: Node) -> None:
        for source in node.inputs.values():
            if isinstance(source, Output) and source.node not in ordered:
                add(nodes[source.node])
        ordered.setdefault(node.id, node)

    for node in nodes.values():
        add(node)
    return list(ordered.values())
