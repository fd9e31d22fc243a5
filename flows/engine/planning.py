"""What of a recipe would run, and why: keys of all results, and which of them are there."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Manifest, Store, digest, key_of
from scan2sim.pipeline.core.errors import DamagedError

STORE = "steps"
"""Folder of kept results, below that of a run."""


class Reason(Enum):
    """Why a node runs; the value says it to the user."""

    NEW = "it was never run"
    CHANGED = "its input, settings or version changed"
    DAMAGED = "its result was damaged or deleted"
    FORCED = "forced"
    REQUESTED = "asked for by --from"
    FOLLOWS = "follows what --from asks for"

    @property
    def again(self) -> bool:
        """Whether it holds though a result may be there."""
        return self in (Reason.FORCED, Reason.REQUESTED, Reason.FOLLOWS)


@dataclass(frozen=True)
class Planned:
    """A node with its key, and why it will run (None: its result is kept).

    Attributes:
        keys: input name to the key (of a node's output) or digest (of a file).
    """

    node: Node
    key: str
    keys: dict[str, str]
    reason: Reason | None

    @property
    def again(self) -> bool:
        """Whether it is to run though its result may be there."""
        return self.reason is not None and self.reason.again

    @property
    def upstream(self) -> list[NodeId]:
        """The nodes whose outputs it reads."""
        return [source.node for source in self.node.inputs.values() if isinstance(source, Output)]

    def fed(self, store: Store) -> str:
        """The key by contents: of what it reads, whatever made it.

        Raises:
            DamagedError: a result that it reads is gone.
        """
        contents = dict(self.keys)
        for name, source in self.node.inputs.items():
            if isinstance(source, Output):
                manifest = self._found(store.find(source.node.full_name, self._key(name)), source)
                contents[name] = f"{manifest.content}/{source.name}"
        return key_of(self.node.step, self.node.params, contents)

    def kept(self, store: Store) -> Manifest | None:
        """Its result if there is one: made before, or made of the same contents; None if it is to run."""
        if self.again:
            return None
        name = self.node.full_name
        return store.find(name, self.key) or store.adopt(name, self.key, self.fed(store), self.keys)

    def inputs(self, store: Store) -> dict[str, Path]:
        """Where the files are that it reads.

        Raises:
            DamagedError: a result that it reads is gone.
        """
        paths = {}
        for name, source in self.node.inputs.items():
            if isinstance(source, Output):
                manifest = self._found(store.read(source.node.full_name, self._key(name)), source)
                paths[name] = store.folder(source.node.full_name, self._key(name)) / manifest.files[source.name]
            else:
                paths[name] = store.source(source)
        return paths

    def check(self, store: Store) -> None:
        """See that what it reads is as it was made; what this run has made isn't read for it.

        Raises:
            DamagedError: naming the node whose result is to be made anew.
        """
        for name, source in self.node.inputs.items():
            if isinstance(source, Output) and not store.intact(source.node.full_name, self._key(name)):
                raise DamagedError(source.node.full_name)

    def _key(self, name: str) -> str:
        return self.keys[name].split("/")[0]

    def _found(self, manifest: Manifest | None, source: Output) -> Manifest:
        if manifest is None:
            raise DamagedError(source.node.full_name, "its result has gone in the meantime")
        return manifest


def plan(
    nodes: Sequence[Node],
    store: Store,
    *,
    force: bool = False,
    start: str | None = None,
    digest: Callable[[Path], str] = digest,
) -> list[Planned]:
    """What would run and why, in order.

    Args:
        force: everything runs again.
        digest: of a source file.
        start: the name of a step that runs again, with all that depends on it.
    """
    planned: dict[NodeId, Planned] = {}
    digests: dict[Path, str] = {}
    for node in nodes:
        keys = {}
        for name, source in sorted(node.inputs.items()):
            if isinstance(source, Output):
                keys[name] = f"{planned[source.node].key}/{source.name}"
            else:
                if source not in digests:
                    digests[source] = digest(source)
                keys[name] = digests[source]
        key = key_of(node.step, node.params, keys)
        reason = _reason(node, key, store)
        if force:
            reason = Reason.FORCED
        elif start is not None and node.step.name == start:
            reason = Reason.REQUESTED
        elif any(planned[s.node].again for s in node.inputs.values() if isinstance(s, Output)):
            reason = Reason.FOLLOWS
        planned[node.id] = Planned(node, key, keys, reason)
    return list(planned.values())


def check(planned: Sequence[Planned]) -> None:
    """Refuse at once a plan with steps that can't run on this machine, where a library or a package is missing.

    Raises:
        UnavailableError: the system lacks libraries.
        ScanError: of the first such step.
    """
    missing = [item.node for item in planned if item.reason is not None]
    if missing:
        system_libs.check()
    for node in missing:
        if node.step.check:
            node.step.check(node.params)


def drop_damaged(planned: Sequence[Planned], store: Store, names: Collection[str]) -> bool:
    """Remove those results of nodes of these names that are kept, and not as they were made; whether there were any."""
    kept = [item for item in planned if item.reason is None and item.node.id.name in names]
    damaged = [item for item in kept if not store.intact(item.node.full_name, item.key)]
    for item in damaged:
        store.discard(item.node.full_name, item.key)
    return bool(damaged)


def _reason(node: Node, key: str, store: Store) -> Reason | None:
    if store.find(node.full_name, key) is not None:
        return None
    if store.folder(node.full_name, key).exists():
        return Reason.DAMAGED
    others = [p for p in (store.root / node.full_name).glob("*") if not p.name.startswith(".")]
    return Reason.CHANGED if others else Reason.NEW
