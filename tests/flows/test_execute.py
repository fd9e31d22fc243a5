"""Planning and execution: what runs again and what doesn't, and that nothing is lost on failures."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import scan2sim
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import execute, run_to_world
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import Planned, Reason, plan
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.run_task import run_node
from scan2sim.flows.engine.versions import APART, check_version, versions
from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.pipeline.core.cache import Digests, Manifest, Store, _seal, digest
from scan2sim.pipeline.core.errors import BusyError, DataError, ScanError, StepError, UnavailableError
from scan2sim.pipeline.core.optional_deps import EXTRA_OF
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from tests.conftest import ROOT
from tests.flows.toy import chain

Run = Callable[..., dict[str, Manifest]]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.txt"
    path.write_text("1", encoding="utf-8")
    return path


@pytest.fixture
def run(tmp_path: Path, source: Path) -> Run:
    """Run the toy chain; keyword arguments by node, or of `plan`."""

    def go(force: bool = False, start: str | None = None, **changes: dict[str, object]) -> dict[str, Manifest]:
        store = Store(tmp_path / "store")
        nodes = chain(source, tmp_path / "log", **changes)
        outcome = execute(plan(nodes, store, force=force, start=start), store, jobs=2, watch=lambda *_: None)
        outcome.check()
        return outcome.of_tile()

    return go


@pytest.fixture
def ran(tmp_path: Path) -> Callable[[], str]:
    """Names of the nodes that ran since the last call, sorted."""

    def take() -> str:
        log = tmp_path / "log"
        text = "".join(sorted(log.read_text(encoding="utf-8").split())) if log.exists() else ""
        log.unlink(missing_ok=True)
        return text

    return take


def test_runs_all_once_then_nothing(run: Run, ran: Callable[[], str]) -> None:
    assert run()["d"].facts == {"total": 2}
    assert ran() == "abcd"
    assert run()["d"].facts == {"total": 2}
    assert ran() == ""


def test_changes_rerun_what_depends_on_them_alone(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    run(c={"value": 5})
    assert ran() == "cd"
    source.write_text("7", encoding="utf-8")
    run(c={"value": 5})
    assert ran() == "abcd"


def test_touching_a_source_without_changing_it_reruns_nothing(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    os.utime(source, (0, 0))
    run()
    assert ran() == ""


def test_what_comes_out_the_same_ends_the_need_to_redo(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    source.write_text("1\n", encoding="utf-8")  # other bytes, the same number
    assert run()["d"].facts == {"total": 2}
    assert ran() == "a"
    run()
    assert ran() == ""
    run(force=True)
    assert ran() == "abcd"


def test_digests_are_remembered_until_a_file_changes(tmp_path: Path, source: Path) -> None:
    file = tmp_path / "digests.json"
    first = Digests(file)
    known = first(source)
    first.save()
    assert Digests(file)(source) == known == digest(source)
    source.write_text("2", encoding="utf-8")
    assert Digests(file)(source) == digest(source) != known


def test_a_failure_is_noted_and_the_rest_goes_on(tmp_path: Path, source: Path, ran: Callable[[], str]) -> None:
    store = Store(tmp_path / "store")
    nodes = chain(source, tmp_path / "log", b={"does": "fail"})
    outcome = execute(plan(nodes, store), store, jobs=1, watch=lambda *_: None, to_the_end=True)
    assert set(outcome.of_tile()) == {"a", "c"} and set(outcome.failed) == {NodeId("b")}
    assert ran() == "abc"


class Ran:
    """A `dispatch.Future` of a node that has run in this process."""

    def __init__(self, item: Planned, store: Store) -> None:
        try:
            self._outcome: object = run_node(item, store, item.inputs(store))
        except ScanError as error:
            self._outcome = error

    def add_done_callback(self, fn: Callable[[object], None]) -> None:
        fn(self)

    def result(self, *, raise_on_failure: bool) -> object:
        return self._outcome


@pytest.mark.parametrize("how", ["processes", "dispatched"])
def test_a_side_product_that_fails_stops_nothing_and_what_reads_it_runs_without_it(
    tmp_path: Path, source: Path, ran: Callable[[], str], how: str
) -> None:
    store = Store(tmp_path / "store")

    def planned(without: Collection[NodeId] = (), **changes: dict[str, object]) -> list[Planned]:
        nodes = []
        for node in chain(source, tmp_path / "log", **changes):
            kept = {name: at for name, at in node.inputs.items() if not (isinstance(at, Output) and at.node in without)}
            if node.id not in without:
                nodes.append(replace(node, inputs=kept, step=replace(node.step, side_product=node.step.name == "b")))
        return plan(nodes, store, force=True)

    def run(planned: list[Planned], store: Store) -> Outcome:
        if how == "dispatched":
            return dispatch(planned, store, lambda item: Ran(item, store), 1, lambda *_: None)
        return execute(planned, store, jobs=1, watch=lambda *_: None)

    broken = partial(planned, b={"does": "bug"})
    last, outcome = run_to_world(broken(), broken, store, run)
    assert ran() == "abcd", "each once, though forced"
    assert {item.node.step.name for item in last} == outcome.of_tile().keys() == {"a", "c", "d"}
    assert outcome.of_tile()["d"].facts == {"total": 1} and not outcome.failed
    assert "a bug" in outcome.side_failed[NodeId("b")].cause and not list((tmp_path / "store" / "b").glob("*"))
    _, outcome = run_to_world(planned(), planned, store, run)
    assert outcome.of_tile()["d"].facts == {"total": 2} and not outcome.side_failed, "it is retried"
    with pytest.raises(DataError, match="to fail"):
        run_to_world(broken(d={"does": "fail"}), partial(broken, d={"does": "fail"}), store, run)


class CountParams(Params):
    """Counts to `to`; is killed on the way unless it began above `above`."""

    to: int = 4
    above: int = 0


def count(inputs: Inputs, params: CountParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Count from where it was killed."""
    known = checkpoint / "known.txt"
    first = int(known.read_text(encoding="utf-8")) if known.exists() else 0
    for number in range(first, params.to):
        known.write_text(str(number + 1), encoding="utf-8")
        if number == 1 and first <= params.above:
            os.kill(os.getpid(), signal.SIGKILL)
    (out / "number.txt").write_text(str(params.to), encoding="utf-8")
    return Done({"number": out / "number.txt"}, {"began": first})


def test_a_long_step_goes_on_where_it_was_killed_with_the_same_input_alone(tmp_path: Path, source: Path) -> None:
    store, step = Store(tmp_path / "store"), Step("count", 1, count, CountParams, resumes=True)

    def run(**params: int) -> Manifest:
        nodes = [Node(step, CountParams(**params), {"source": source})]
        outcome = execute(plan(nodes, store), store, jobs=1, watch=lambda *_: None)
        outcome.check()
        return outcome.of_tile()["count"]

    with pytest.raises(StepError, match="killed"):
        run()
    assert run(above=-1).facts == {"began": 0}, "other parameters begin anew"
    assert len(list((store.root / "count").glob(".part-*"))) == 1
    assert run().facts == {"began": 2} and not list((store.root / "count").glob(".part-*"))
    with pytest.raises(StepError, match="killed"):
        run(to=5)
    source.write_text("another", encoding="utf-8")
    with pytest.raises(StepError, match="killed"):
        run(to=5)
    parts = list((store.root / "count").glob(".part-*"))
    assert len(parts) == 2
    store.sweep({"count": "another key"})
    assert not list((store.root / "count").iterdir())


def test_a_folder_is_a_source_by_its_files(tmp_path: Path) -> None:
    folder, digests = tmp_path / "frames", Digests(tmp_path / "digests.json")
    folder.mkdir()
    (folder / "1.png").write_bytes(b"one")
    before = digest(folder)
    assert digests(folder) == before != digest(tmp_path / "absent")
    (folder / "1.png").rename(folder / "2.png")
    assert digests(folder) == digest(folder) != before


def test_a_deleted_output_is_rebuilt_and_nothing_else(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    next((tmp_path / "store" / "b").rglob("number.txt")).unlink()
    run()
    assert ran() == "b"


def number(tmp_path: Path, name: str) -> Path:
    return next((tmp_path / "store" / name).rglob("number.txt"))


def test_a_changed_output_is_redone_and_nothing_else(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    number(tmp_path, "b").write_text("7", encoding="utf-8")  # as many bytes
    assert run()["d"].facts == {"total": 2}
    assert ran() == "b" and number(tmp_path, "b").read_text(encoding="utf-8") == "1"


def test_damage_that_leaves_no_trace_is_found_when_it_is_read(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    damaged = number(tmp_path, "a")
    stat = damaged.stat()
    damaged.write_text("7", encoding="utf-8")
    os.utime(damaged, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    run()
    assert ran() == "", "what isn't read is looked at, not into"
    assert run(c={"value": 5})["d"].facts == {"total": 7}
    assert ran() == "acd" and number(tmp_path, "a").read_text(encoding="utf-8") == "1"


def test_a_store_that_was_copied_is_as_good(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    shutil.copytree(tmp_path / "store", tmp_path / "copy", copy_function=shutil.copyfile)
    for file in (tmp_path / "copy").rglob("number.txt"):
        os.utime(file)
    shutil.rmtree(tmp_path / "store")
    (tmp_path / "copy").rename(tmp_path / "store")
    run()
    assert ran() == ""


def test_a_manifest_that_is_damaged_is_none(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    path = number(tmp_path, "d").with_name("manifest.json")
    path.write_text(path.read_text(encoding="utf-8").replace('"total": 2', '"total": 3'), encoding="utf-8")
    assert run()["d"].facts == {"total": 2}
    assert ran() == "d"


@pytest.mark.parametrize("name", ["/etc/hostname", "../../../secret.txt", "link/secret.txt", "link.txt", "a\0b"])
def test_a_manifest_that_leads_elsewhere_is_refused(
    run: Run, ran: Callable[[], str], tmp_path: Path, name: str
) -> None:
    run()
    ran()
    (tmp_path / "secret.txt").write_text("1", encoding="utf-8")
    folder = number(tmp_path, "a").parent
    (folder / "link").symlink_to(tmp_path)
    (folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    body = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    del body["seal"]
    body["files"] = {"number": name}
    (folder / "manifest.json").write_text(json.dumps(body | {"seal": _seal(body)}), encoding="utf-8")
    run(b={"value": 3})
    assert ran() == "abd"


def test_from_a_step_reruns_it_and_what_follows(run: Run, ran: Callable[[], str]) -> None:
    run()
    ran()
    run(start="c")
    assert ran() == "cd"
    run(force=True)
    assert ran() == "abcd"


def test_a_failing_step_keeps_what_was_done(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="told to fail"):
        run(d={"does": "fail"})
    ran()
    assert not list((tmp_path / "store" / "d").glob("*"))
    run()
    assert ran() == "d"


def test_a_bug_and_a_killed_process_become_step_errors(run: Run) -> None:
    with pytest.raises(StepError, match="a bug"):
        run(b={"does": "bug"})
    with pytest.raises(StepError, match="killed"):
        run(b={"does": "die"})


@pytest.mark.parametrize("how", ["litter", "bug", "SIGINT"])
def test_whatever_ends_a_run_nothing_but_its_message_is_shown(tmp_path: Path, source: Path, how: str) -> None:
    script = (
        "import sys; from pathlib import Path; from scan2sim.flows.engine.execution import *\n"
        "from scan2sim.flows.engine.planning import *; from scan2sim.pipeline.core.errors import *\n"
        "from tests.flows.toy import chain\n"
        f"p, does = Path({str(tmp_path)!r}), {'hang' if how == 'SIGINT' else how!r}\n"
        "store = Store(p / 'store')\n"
        "nodes = chain(p / 'source.txt', p / 'log', b={'does': does}, c={'does': 'hang'})\n"
        "try: execute(plan(nodes, store), store, jobs=2, watch=lambda *_: None).check()\n"
        "except ScanError as error: sys.exit(str(error))\n"
        "except KeyboardInterrupt: sys.exit('interrupted')\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    if how == "SIGINT":
        while child.poll() is None and not (tmp_path / "pid_b").exists():
            time.sleep(0.05)
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does
    said = "".join(child.communicate(timeout=120))
    assert len(said.splitlines()) == 1 and "Traceback" not in said, said
    message = {"litter": "was killed", "bug": "failed unexpectedly", "SIGINT": "interrupted"}[how]
    assert message in said


def test_ctrl_c_before_anything_runs_is_quiet_too(tmp_path: Path, source: Path) -> None:
    script = (
        "import os, signal, sys; from scan2sim.flows.engine import processes\n"
        "try:\n"
        "    processes._processes(); os.killpg(0, signal.SIGINT); import time; time.sleep(20)\n"
        "except KeyboardInterrupt: sys.exit('interrupted')\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60, start_new_session=True
    )
    assert (child.stdout + child.stderr).strip() == "interrupted"


def test_plan_says_why(tmp_path: Path, source: Path, run: Run) -> None:
    run()
    store = Store(tmp_path / "store")

    def reasons(**changes: dict[str, object]) -> dict[str, Reason | None]:
        return {p.node.full_name: p.reason for p in plan(chain(source, tmp_path / "log", **changes), store)}

    assert set(reasons().values()) == {None}
    changed = reasons(b={"value": 1})
    assert changed["a"] is None and changed["c"] is None
    assert changed["b"] is Reason.CHANGED


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with locked(tmp_path / "out"), pytest.raises(BusyError, match="another run"), locked(tmp_path / "out"):
        pass


def test_kill_9_leaves_nothing_half_made_and_no_process_behind(tmp_path: Path, source: Path, run: Run) -> None:
    script = (
        "from pathlib import Path; from scan2sim.flows.engine.execution import *\n"
        "from scan2sim.flows.engine.planning import plan; from tests.flows.toy import chain\n"
        f"p = Path({str(tmp_path)!r}); s = Store(p / 'store')\n"
        "execute(plan(chain(p / 'source.txt', p / 'log', b={'does': 'hang'}), s), s, jobs=1, watch=lambda *_: None)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
    log = tmp_path / "log"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (tmp_path / "pid_b").exists():
        time.sleep(0.05)
    hanging = (tmp_path / "pid_b").read_text(encoding="utf-8")
    child.send_signal(signal.SIGKILL)
    child.wait()
    store = Store(tmp_path / "store")
    kept = {p.node.full_name: p.reason for p in plan(chain(source, log), store)}
    assert kept["a"] is None and kept["b"] is not None
    assert run()["d"].facts == {"total": 2}
    pid = (tmp_path / "pid_b").read_text(encoding="utf-8")  # of the run above, which ended
    assert hanging != pid
    while time.monotonic() < deadline and Path(f"/proc/{hanging}").exists():
        time.sleep(0.1)
    assert not Path(f"/proc/{hanging}").exists()


def test_versions_are_told_of_all_that_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"], *(f'{one}; extra == "{name}"' for name in extras for one in extras[name])]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: lines)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: f"1 of {name}")
    found = versions.__wrapped__()
    computing = {"numpy", "numba", "scipy", "pyproj", "torch", "onnxruntime", "pycolmap", "opencv-python-headless"}
    computing |= {package for package, extra in EXTRA_OF.items() if extra not in APART} - {"pxr", "kiss_icp"}
    computing |= {"usd-core", "kiss-icp"}
    assert computing <= found.keys()
    assert found["scan2sim"] == scan2sim.__version__ and not {"prefect", "ray", "s3fs", "pytest"} & found.keys()


def test_a_worker_with_another_numba_is_refused_but_not_one_without_plots(tmp_path: Path, source: Path) -> None:
    node = plan(chain(source, tmp_path / "log"), Store(tmp_path / "store"))[0]
    check_version(node, dict(versions()) | {"a-package-of-an-extra": "1"})
    with pytest.raises(UnavailableError, match=r"numba .* instead of 0\.1"):
        check_version(node, dict(versions()) | {"numba": "0.1"})


def test_versions_are_told_without_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", none)
    assert versions.__wrapped__() == {"python": sys.version.split()[0], "scan2sim": scan2sim.__version__}
