"""Workers on other machines: network drives that show results late, machines with another disk at the same path."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.engine.dispatch import VISIBLE_ATTEMPTS, dispatch
from scan2sim.flows.engine.execution import run_on_worker
from scan2sim.flows.engine.planning import PlannedTask, plan
from scan2sim.flows.engine.run_task import run_task
from scan2sim.flows.engine.shared_disk import SharedDisk, shared
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.engine.workers import STEPS_OF_EMPTY_CLUSTER, workers
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import DamagedError, InputError, UnavailableError
from tests.flows.toy import chain


class LateStore(Store):
    """A store on a network drive: a result appears only after its folders were compared with the server's `late` times.

    Attributes:
        late: number of times; results that were seen once stay visible.
    """

    late = 0

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._seen = set[tuple[str, str]]()

    def find(self, task: str, key: str) -> Manifest | None:
        """As `Store.find`."""
        if self.late > 0 and (task, key) not in self._seen:
            return None
        manifest = super().find(task, key)
        if manifest is not None:
            self._seen.add((task, key))
        return manifest

    def revalidate(self, task: str = "", key: str = "") -> None:
        """Count the comparison."""
        self.late -= 1


class Finished:
    """The future of a task that another machine has run; `late` as of `LateStore`."""

    def __init__(self, item: PlannedTask, store: LateStore, late: int) -> None:
        elsewhere = Store(store.root)
        run_task(item, elsewhere, item.inputs(elsewhere))
        store.late = late

    def add_done_callback(self, fn: Callable[[Any], None]) -> None:
        """The task has ended."""
        fn(self)

    def result(self, *, raise_on_failure: bool) -> Any:
        """The path of its manifest."""
        return "its manifest's path"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.txt"
    path.write_text("1", encoding="utf-8")
    return path


def test_results_that_a_network_drive_shows_late_are_waited_for(source: Path, tmp_path: Path) -> None:
    store, pauses = LateStore(tmp_path / "steps"), list[float]()
    planned = plan(chain(source, tmp_path / "log"), store)
    outcome = dispatch(planned, store, lambda item: Finished(item, store, 40), 1, lambda *_: None, sleep=pauses.append)
    assert not outcome.failed and outcome.of_tile()["d"].metrics == {"total": 2}
    assert len(pauses) == 4 * 39


def test_results_that_appear_when_folders_are_compared_cost_no_pause(source: Path, tmp_path: Path) -> None:
    """As with NFS, which otherwise caches for a minute that a file is absent: each step would take a second longer."""
    store, pauses = LateStore(tmp_path / "steps"), list[float]()
    planned = plan(chain(source, tmp_path / "log"), store)
    outcome = dispatch(planned, store, lambda item: Finished(item, store, 1), 1, lambda *_: None, sleep=pauses.append)
    assert set(outcome.of_tile()) == set("abcd") and not pauses


class Lost(Finished):
    """The future of a task whose worker is given up, but finishes it nevertheless."""

    def result(self, *, raise_on_failure: bool) -> Any:
        """The error of the runner."""
        return RuntimeError("the worker doesn't answer")


def test_result_of_a_worker_that_was_given_up_is_used(source: Path, tmp_path: Path) -> None:
    store = LateStore(tmp_path / "steps")
    planned = plan(chain(source, tmp_path / "log"), store)
    outcome = dispatch(planned, store, lambda item: Lost(item, store, 0), 1, lambda *_: None)
    assert not outcome.failed and set(outcome.of_tile()) == set("abcd")
    planned = plan(chain(source, tmp_path / "log"), store, force=True)
    outcome = dispatch(planned, store, lambda item: Lost(item, store, 0), 1, lambda *_: None)
    (error,) = outcome.failed.values()
    assert "the worker doesn't answer" in error.cause, "a forced step isn't taken for done by its earlier result"


def test_result_on_another_disk_is_explained(source: Path, tmp_path: Path) -> None:
    store, pauses = LateStore(tmp_path / "steps"), list[float]()
    planned = plan(chain(source, tmp_path / "log"), store)
    alone = [item for item in planned if item.task.id.name == "a"]
    two = [*alone, replace(alone[0], task=replace(alone[0].task, tile="other"))]
    outcome = dispatch(two, store, lambda item: Finished(item, store, 999), 1, lambda *_: None, sleep=pauses.append)
    for error in outcome.failed.values():
        assert isinstance(error, UnavailableError) and "doesn't appear on this machine" in error.cause
        assert "same path" in error.remedy
    assert len(outcome.failed) == 2 and len(pauses) == VISIBLE_ATTEMPTS + 1, "only the first one is waited for"


def test_input_that_is_not_visible_yet_is_not_rebuilt(source: Path, tmp_path: Path) -> None:
    first, second = plan(chain(source, tmp_path / "log"), Store(tmp_path / "steps"))[:2]

    def late(times: int) -> LateStore:
        store = LateStore(tmp_path / "steps")
        store.late = times
        return store

    run_task(first, late(0), first.inputs(late(0)))
    assert second.inputs(late(1))["a"].is_file()
    second.content_key(late(1))
    with pytest.raises(DamagedError):
        second.inputs(late(2))


def test_second_worker_that_finishes_a_step_leaves_the_result_to_its_readers(source: Path, tmp_path: Path) -> None:
    """A worker without network for minutes is replaced, but ends its step nevertheless."""
    store = Store(tmp_path / "steps")
    item = plan(chain(source, tmp_path / "log"), store)[0]
    run_task(item, store, item.inputs(store))
    number = store.folder("a", item.key) / "number.txt"
    inode = number.stat().st_ino
    run_task(item, store, item.inputs(store))
    assert number.stat().st_ino == inode
    number.write_text("7", encoding="utf-8")
    run_task(item, store, item.inputs(store))
    assert number.read_text(encoding="utf-8") == "1", "a damaged result is replaced"
    assert [path.name for path in (tmp_path / "steps" / "a").iterdir()] == [item.key]


def test_result_that_appears_while_it_is_moved_into_place(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "steps")
    item = plan(chain(source, tmp_path / "log"), store)[0]
    target = store.folder("a", item.key)

    def not_yet(*_: object) -> bool:
        target.mkdir()
        (target / "half").touch()
        return False

    monkeypatch.setattr(store, "_has_same", not_yet)
    manifest = run_task(item, store, item.inputs(store))
    found = store.find("a", item.key)
    assert found is not None and found.content == manifest.content and not (target / "half").exists()


def test_machine_that_finds_everything_damaged_does_not_keep_the_others_busy(source: Path, tmp_path: Path) -> None:
    class Broken(Finished):
        def __init__(self, item: PlannedTask, store: LateStore) -> None:
            super().__init__(item, store, 0)
            self._name = item.task.id.name

        def result(self, *, raise_on_failure: bool) -> Any:
            return DamagedError("a") if self._name == "b" else super().result(raise_on_failure=raise_on_failure)

    store = LateStore(tmp_path / "steps")
    planned = plan(chain(source, tmp_path / "log"), store)
    outcome = dispatch(planned, store, lambda item: Broken(item, store), 1, lambda *_: None)
    (error,) = outcome.failed.values()
    assert error.where == "b" and "a, which it reads, is damaged after each of 3 rebuilds" in error.cause
    assert set(outcome.of_tile()) == {"a", "c"}
    assert (tmp_path / "log").read_text(encoding="utf-8").split().count("a") == 4


def test_worker_with_another_disk_writes_nothing(source: Path, tmp_path: Path) -> None:
    item = plan(chain(source, tmp_path / "log"), Store(tmp_path / "steps"))[0]
    with shared(Store(tmp_path / "steps")) as disk:
        disk.check(Store(tmp_path / "steps"))
        other = Store(tmp_path / "unmounted" / "steps")
        with pytest.raises(UnavailableError, match=f"steps on {platform.node()}: isn't the folder.*same path"):
            run_on_worker(item, other, None, None, versions(), None, disk)
    assert not other.root.exists() and not (tmp_path / "log").exists()


def test_mark_of_a_flow_ends_with_it(tmp_path: Path) -> None:
    store = Store(tmp_path / "steps")
    store.root.mkdir()
    (store.root / ".run-killed").touch()
    with shared(store) as disk:
        assert [path.name for path in store.root.iterdir()] == [disk.mark]
    assert not list(store.root.iterdir())


def test_cluster_without_workers_is_named() -> None:
    """Dask waits for them without a message."""
    distributed = pytest.importorskip("distributed", reason="Dask isn't installed")
    said = list[str]()
    options = {"n_workers": 0, "processes": False, "dashboard_address": None, "host": "127.0.0.1", "protocol": "tcp"}
    with distributed.LocalCluster(**options) as cluster:
        address = cluster.scheduler_address
        with workers("dask", 0, address, said.append) as empty:
            assert empty.count == STEPS_OF_EMPTY_CLUSTER, "a cluster that grows on demand sees a demand"
    (text,) = said
    assert f"{address} has no workers" in text and f"`dask worker {address}`" in text


def test_all_workers_of_a_cluster_are_used_by_default() -> None:
    distributed = pytest.importorskip("distributed", reason="Dask isn't installed")
    options = {"processes": False, "dashboard_address": None, "host": "127.0.0.1", "protocol": "tcp"}
    with distributed.LocalCluster(n_workers=3, threads_per_worker=2, **options) as cluster:
        for given, used in ((0, 6), (4, 4)):
            with workers("dask", given, cluster.scheduler_address) as there:
                assert there.count == used and there.call(sum, [1, 2]) == 3


def test_errors_name_a_worker_on_another_machine() -> None:
    error = InputError("cloud.laz", "file not found", "Check the path")
    SharedDisk(None, platform.node()).name_worker(error)
    assert error.cause == "file not found"
    SharedDisk(None, "the flow's machine").name_worker(error)
    assert error.cause == f"file not found (on {platform.node()})"
