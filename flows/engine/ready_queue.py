"""How far a plan has come: which of its nodes can run next, and what came of the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.pipelines.graph import Node, NodeId
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError

Event = Literal["start", "progress", "done", "kept", "failed", "again"]
Watch = Callable[[Node, Event, float, str], None]
"""Told what happens: node, event, fraction done, message."""


def unwatched(node: Node, event: Event, fraction: float, message: str) -> None:
    """A `Watch` that tells nobody."""


@dataclass(frozen=True)
class Outcome:
    """What came of a plan.

    Attributes:
        done: results, what is kept from before among them.
        failed: why others failed; what depends on them is in neither.
        side_failed: the same of side products.
    """

    done: Mapping[NodeId, Manifest]
    failed: Mapping[NodeId, ScanError]
    side_failed: Mapping[NodeId, ScanError] = field(default_factory=dict)

    def of_tile(self, tile: str = "") -> dict[str, Manifest]:
        """Results of one tile by their names within it (`poisson.terrain`)."""
        return {node.name: manifest for node, manifest in self.done.items() if node.tile == tile}

    def check(self) -> None:
        """Raise the first error, if any node failed that isn't a side product."""
        for error in self.failed.values():
            raise error


class Frontier:
    """Which nodes of a plan can run next, as results come in.

    Attributes:
        done: results; what is kept from before comes by itself.
        failed, side_failed: why others failed.
    """

    def __init__(self, planned: Sequence[Planned], store: Store, watch: Watch) -> None:
        self.done: dict[NodeId, Manifest] = {}
        self.failed: dict[NodeId, ScanError] = {}
        self.side_failed: dict[NodeId, ScanError] = {}
        self._store, self._watch = store, watch
        self._planned = {item.node.id: item for item in planned}
        self._by_name = {item.node.full_name: item.node.id for item in planned}
        self._waiting = dict(self._planned)
        self._missing: set[NodeId] = set()  # known not to be kept
        self._lost: set[NodeId] = set()  # failed, or in need of what failed

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def outcome(self) -> Outcome:
        """As far as the plan has come."""
        return Outcome(self.done, self.failed, self.side_failed)

    def ready(self) -> Iterator[Planned]:
        """Nodes that can run now, in the plan's order; to be taken, or offered again."""
        for node, item in list(self._waiting.items()):
            if not self._lost.isdisjoint(item.upstream):
                self.take(item)
                self._lost.add(node)
            elif all(name in self.done for name in item.upstream):
                kept = None if node in self._missing else item.kept(self._store)
                if kept is None:
                    self._missing.add(node)
                    yield item
                else:
                    self.take(item)
                    self.done[node] = kept
                    self._watch(item.node, "kept", 1.0, "")

    def take(self, item: Planned) -> None:
        """The node has been started."""
        self._waiting.pop(item.node.id, None)

    def end(self, item: Planned, manifest: Manifest) -> None:
        """The node is done; what it has read was intact."""
        self.done[item.node.id] = manifest
        for node in (item.node.id, *item.upstream):
            self._store.trust(node.full_name, self._planned[node].key)
        self._watch(item.node, "done", 1.0, "")

    def again(self, item: Planned, error: DamagedError) -> None:
        """The node has met a result that is damaged: that is made anew, and the node waits for it."""
        self._waiting[item.node.id] = item
        damaged = self._by_name[error.where]
        if self.done.pop(damaged, None) is not None:
            self._store.discard(damaged.full_name, self._planned[damaged].key)
            self._missing.add(damaged)
            self._waiting[damaged] = self._planned[damaged]
        self._watch(item.node, "again", 0.0, f"the kept result of {damaged} is damaged: made anew")

    def fail(self, item: Planned, error: ScanError) -> None:
        """The node, and whatever depends on it, will not be done."""
        self.take(item)
        self._lost.add(item.node.id)
        (self.side_failed if item.node.step.side_product else self.failed)[item.node.id] = error
        self._watch(item.node, "failed", 1.0, error.cause)
