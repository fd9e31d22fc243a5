"""Plans the execution of a graph: computes the cache key of each task, and which tasks must run and why."""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.cache import Manifest, Store, digest, key_of
from scan2sim.pipeline.core.errors import DamagedError

STORE = "steps"
"""Name of the folder of cached results within an output folder."""


UNLESS_SAME = "input may change: reused if it turns out the same"


class Reason(Enum):
    """Reason why a task runs; the value is shown to the user."""

    NEW = "never run before"
    CHANGED = "input, settings or version changed"
    DAMAGED = "cached result damaged or deleted"
    RETRIED = "a part of its result failed"
    FORCED = "requested by --force"
    REQUESTED = "requested by --from"
    FOLLOWS = "depends on the step of --from"

    @property
    def ignores_cache(self) -> bool:
        """Whether the task runs even if its result is cached."""
        return self in (Reason.FORCED, Reason.REQUESTED, Reason.FOLLOWS)


@dataclass(frozen=True)
class PlannedTask:
    """A task with its cache key, and the reason why it will run.

    Attributes:
        task: the task.
        key: cache key of its result.
        keys: input name to the key (of a task's output) or digest (of a file).
        reason: why it will run; None: its result is cached.
    """

    task: Task
    key: str
    keys: dict[str, str]
    reason: Reason | None

    @property
    def ignores_cache(self) -> bool:
        """Whether it runs even if its result is cached."""
        return self.reason is not None and self.reason.ignores_cache

    @property
    def upstream(self) -> list[TaskId]:
        """The tasks whose outputs it reads."""
        return [source.task for source in self.task.inputs.values() if isinstance(source, Output)]

    def content_key(self, store: Store) -> str:
        """Cache key by the contents of the inputs, independent of how these were computed.

        Raises:
            DamagedError: a result that it reads is missing.
        """
        contents = dict(self.keys)
        for name, source in self.task.inputs.items():
            if isinstance(source, Output):
                manifest = self._result(name, source, store, store.find)
                contents[name] = f"{manifest.content_of(source.name)}/{source.name}"
        return key_of(self.task.step, self.task.params, contents)

    def cached_result(self, store: Store) -> Manifest | None:
        """Its cached result, by key or by equal input contents; None if it must run."""
        if self.ignores_cache:
            return None
        name = self.task.full_name
        found = store.find(name, self.key)
        if found is not None and found.failed and not store.is_verified(name, self.key):
            return None
        return found or store.reuse_same_content(name, self.key, self.content_key(store), self.keys)

    def inputs(self, store: Store) -> dict[str, Path]:
        """Paths of its input files by name.

        Raises:
            DamagedError: a result that it reads is missing.
            InputError: a source in object storage has changed since the task was planned.
        """
        paths = {}
        for name, source in self.task.inputs.items():
            if isinstance(source, Output):
                manifest = self._result(name, source, store, store.read)
                paths[name] = store.folder(source.task.full_name, self._key(name)) / manifest.files[source.name]
            else:
                paths[name] = store.source(source, self.keys[name])
        return paths

    def check(self, store: Store) -> None:
        """Verify the digests of the cached results that it reads, except those computed by this run.

        Raises:
            DamagedError: names the task whose result must be rebuilt.
        """
        for name, source in self.task.inputs.items():
            if isinstance(source, Output) and not store.intact(source.task.full_name, self._key(name)):
                raise DamagedError(source.task.full_name)

    def _key(self, name: str) -> str:
        return self.keys[name].split("/")[0]

    def _result(self, name: str, source: Output, store: Store, find: Callable[[str, str], Manifest | None]) -> Manifest:
        """The result that an input comes from, which another machine may just have written."""
        task, key = source.task.full_name, self._key(name)
        manifest = find(task, key)
        if manifest is None:
            store.revalidate(task, key)
            manifest = find(task, key)
        if manifest is None:
            raise DamagedError(source.task.full_name, "its result was deleted during the run")
        return manifest


def plan(
    tasks: Sequence[Task],
    store: Store,
    *,
    force: bool = False,
    start: str | None = None,
    digest: Callable[[Path], str] = digest,
) -> list[PlannedTask]:
    """Plan the tasks of a graph, in its order.

    Args:
        tasks: each after those that it reads.
        store: cache of the results.
        force: run all tasks.
        start: name of a step to run, with all tasks that depend on it.
        digest: function that computes the digest of a source file.
    """
    with collector_paused():
        return _plan(tasks, store, force, start, digest)


@contextmanager
def collector_paused() -> Iterator[None]:
    """Without the garbage collector, which scans the growing graph of a large survey again and again, for nothing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _plan(
    tasks: Sequence[Task], store: Store, force: bool, start: str | None, digest: Callable[[Path], str]
) -> list[PlannedTask]:
    planned: dict[TaskId, PlannedTask] = {}
    digests: dict[Path, str] = {}
    for task in tasks:
        keys = {}
        for name, source in sorted(task.inputs.items()):
            if isinstance(source, Output):
                keys[name] = f"{planned[source.task].key}/{source.name}"
            else:
                if source not in digests:
                    digests[source] = digest(source)
                keys[name] = digests[source]
        key = key_of(task.step, task.params, keys)
        reason = _reason(task, key, store)
        if force:
            reason = Reason.FORCED
        elif start is not None and task.step.name == start:
            reason = Reason.REQUESTED
        elif any(planned[s.task].ignores_cache for s in task.inputs.values() if isinstance(s, Output)):
            reason = Reason.FOLLOWS
        planned[task.id] = PlannedTask(task, key, keys, reason)
    return list(planned.values())


def why(item: PlannedTask, store: Store) -> str:
    """Why a task runs, or that its result is cached; of a change, what changed since its newest cached result."""
    if item.reason is None:
        return "cached: same input, settings and version"
    if item.reason is not Reason.CHANGED:
        return item.reason.value
    task, last = item.task, store.newest(item.task.full_name)
    if last is None:
        return item.reason.value
    if last.version != task.step.version:
        return f"version of the step changed: {last.version} -> {task.step.version}"
    params = task.params.model_dump(mode="json")
    changed = sorted(name for name in params.keys() | last.params.keys() if params.get(name) != last.params.get(name))
    if changed:
        names = [name for name in changed if name != "context"]
        texts = [f"{name} {last.params.get(name)} -> {params.get(name)}" for name in names]
        return f"settings changed: {', '.join(texts)}" if texts else "settings of other steps changed"
    files = {name for name, source in task.inputs.items() if not isinstance(source, Output)}
    changed = sorted(name for name in files if item.keys[name] != last.inputs.get(name))
    if changed:
        return f"input files changed: {', '.join(changed)}"
    return UNLESS_SAME


def check(planned: Sequence[PlannedTask]) -> None:
    """Reject a plan with steps that can't run on this machine because a library or package is missing.

    Raises:
        UnavailableError: system libraries are missing.
        ScanError: the first step that can't run.
    """
    missing = [item.task for item in planned if item.reason is not None]
    if missing:
        system_libs.check()
    for task in missing:
        if task.step.check:
            task.step.check(task.params)


def drop_damaged(planned: Sequence[PlannedTask], store: Store, names: Collection[str]) -> bool:
    """Delete the damaged cached results of tasks of these names; returns whether there were any."""
    cached = [item for item in planned if item.reason is None and item.task.id.name in names]
    damaged = [item for item in cached if not store.intact(item.task.full_name, item.key)]
    for item in damaged:
        store.discard(item.task.full_name, item.key)
    return bool(damaged)


def _reason(task: Task, key: str, store: Store) -> Reason | None:
    found = store.find(task.full_name, key)
    if found is not None:
        return Reason.RETRIED if found.failed and not store.is_verified(task.full_name, key) else None
    keys = store.keys(task.full_name)
    if key in keys:
        return Reason.DAMAGED
    return Reason.CHANGED if keys else Reason.NEW
