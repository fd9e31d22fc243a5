"""Planning and execution: which tasks run again, and that failures lose no results."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import scan2sim
from scan2sim.flows.commands.log import Log
from scan2sim.flows.engine.dispatch import dispatch
from scan2sim.flows.engine.execution import execute, run_to_world
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import PlannedTask, Reason, plan, why
from scan2sim.flows.engine.ready_queue import Outcome
from scan2sim.flows.engine.run_task import run_task
from scan2sim.flows.engine.versions import EXTRAS_WITHOUT_STEPS, check_version, versions
from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.pipeline.core.cache import Digests, Manifest, Store, _seal, digest
from scan2sim.pipeline.core.errors import BusyError, DataError, ScanError, StepError, UnavailableError
from scan2sim.pipeline.core.optional_deps import EXTRA_OF
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from tests.conftest import ROOT
from tests.flows.toy import chain
from tests.waiting import until

Run = Callable[..., dict[str, Manifest]]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.txt"
    path.write_text("1", encoding="utf-8")
    return path


@pytest.fixture
def run(tmp_path: Path, source: Path) -> Run:
    """Run the toy graph; keyword arguments are parameters by task, or of `plan`."""

    def go(force: bool = False, start: str | None = None, **changes: dict[str, object]) -> dict[str, Manifest]:
        store = Store(tmp_path / "store")
        tasks = chain(source, tmp_path / "log", **changes)
        outcome = execute(plan(tasks, store, force=force, start=start), store, jobs=2, on_event=lambda *_: None)
        outcome.check()
        return outcome.of_tile()

    return go


@pytest.fixture
def ran(tmp_path: Path) -> Callable[[], str]:
    """Names of the tasks that ran since the last call, sorted."""

    def take() -> str:
        log = tmp_path / "log"
        text = "".join(sorted(log.read_text(encoding="utf-8").split())) if log.exists() else ""
        log.unlink(missing_ok=True)
        return text

    return take


def test_second_run_uses_the_cache(run: Run, ran: Callable[[], str]) -> None:
    assert run()["d"].metrics == {"total": 2}
    assert ran() == "abcd"
    assert run()["d"].metrics == {"total": 2}
    assert ran() == ""


def test_changes_rerun_only_dependent_tasks(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    run(c={"value": 5})
    assert ran() == "cd"
    source.write_text("7", encoding="utf-8")
    run(c={"value": 5})
    assert ran() == "abcd"


def test_new_modification_time_alone_reruns_nothing(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    os.utime(source, (0, 0))
    run()
    assert ran() == ""


def test_unchanged_output_cuts_off_dependent_tasks(run: Run, ran: Callable[[], str], source: Path) -> None:
    run()
    ran()
    source.write_text("1\n", encoding="utf-8")  # other bytes, the same number
    assert run()["d"].metrics == {"total": 2}
    assert ran() == "a"
    run()
    assert ran() == ""
    run(force=True)
    assert ran() == "abcd"


def test_digests_are_cached_until_a_file_changes(tmp_path: Path, source: Path) -> None:
    file = tmp_path / "digests.json"
    first = Digests(file)
    known = first(source)
    first.save()
    assert Digests(file)(source) == known == digest(source)
    source.write_text("2", encoding="utf-8")
    assert Digests(file)(source) == digest(source) != known


def test_digests_notice_a_file_that_was_overwritten_with_its_old_time(tmp_path: Path, source: Path) -> None:
    before = source.stat()
    digests = Digests(tmp_path / "digests.json", clock=lambda: before.st_ctime_ns + 10**10)
    known = digests(source)
    digests.save()
    while source.stat().st_ctime_ns == before.st_ctime_ns:  # clocks of disks are coarse
        source.write_text("2", encoding="utf-8")  # as many bytes
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert Digests(tmp_path / "digests.json")(source) == digest(source) != known


def test_digests_of_files_that_may_still_be_written_are_not_kept(tmp_path: Path, source: Path) -> None:
    written = source.stat().st_ctime_ns
    for age, kept in ((10**9, 0), (10**10, 1)):
        digests = Digests(tmp_path / "digests.json", clock=partial(int, written + age))
        assert digests(source) == digest(source)
        digests.save()
        assert len(json.loads((tmp_path / "digests.json").read_text(encoding="utf-8"))) == kept


def test_keep_going_runs_all_independent_tasks(tmp_path: Path, source: Path, ran: Callable[[], str]) -> None:
    store = Store(tmp_path / "store")
    tasks = chain(source, tmp_path / "log", b={"does": "fail"})
    outcome = execute(plan(tasks, store), store, jobs=1, on_event=lambda *_: None, keep_going=True)
    assert set(outcome.of_tile()) == {"a", "c"} and set(outcome.failed) == {TaskId("b")}
    assert ran() == "abc"


class FinishedFuture:
    """A `dispatch.Future` of a task that has run in this process."""

    def __init__(self, item: PlannedTask, store: Store) -> None:
        try:
            self._outcome: object = run_task(item, store, item.inputs(store))
        except ScanError as error:
            self._outcome = error

    def add_done_callback(self, fn: Callable[[object], None]) -> None:
        fn(self)

    def result(self, *, raise_on_failure: bool) -> object:
        return self._outcome


def test_result_with_a_failed_part_is_used_once_and_made_again_by_the_next_run(
    tmp_path: Path, source: Path, ran: Callable[[], str]
) -> None:
    broken = tmp_path / "broken"
    broken.touch()

    def run() -> tuple[dict[TaskId, Reason | None], Outcome]:
        store = Store(tmp_path / "store")

        def planned(without: Collection[TaskId] = ()) -> list[PlannedTask]:
            left_out = {*without, TaskId("d")} if without else set()
            tasks = chain(source, tmp_path / "log", b={"does": "part"}, c={"does": "bug"})
            kept = [replace(task, side_product=task.id.name in "cd") for task in tasks if task.id not in left_out]
            return plan(kept, store)

        first = planned()
        _, outcome = run_to_world(first, planned, store, partial(execute, jobs=1, on_event=lambda *_: None))
        return {item.task.id: item.reason for item in first}, outcome

    for _ in range(2):
        reasons, outcome = run()
        assert list(outcome.done[TaskId("b")].failed) == ["part"]
        assert ran().count("b") == 1, "once in a run, although it is planned again without a side product"
    assert reasons[TaskId("a")] is None and reasons[TaskId("b")] is Reason.RETRIED
    broken.unlink()
    assert not run()[1].done[TaskId("b")].failed and ran() == "bc"
    assert run()[0][TaskId("b")] is None and ran() == "c"


@pytest.mark.parametrize("how", ["processes", "dispatched"])
def test_failed_side_product_is_left_out_and_its_readers_run_without_it(
    tmp_path: Path, source: Path, ran: Callable[[], str], how: str
) -> None:
    store = Store(tmp_path / "store")

    def planned(without: Collection[TaskId] = (), **changes: dict[str, object]) -> list[PlannedTask]:
        tasks = []
        for task in chain(source, tmp_path / "log", **changes):
            kept = {name: at for name, at in task.inputs.items() if not (isinstance(at, Output) and at.task in without)}
            if task.id not in without:
                tasks.append(replace(task, inputs=kept, side_product=task.step.name == "b"))
        return plan(tasks, store, force=True)

    def run(planned: list[PlannedTask], store: Store) -> Outcome:
        if how == "dispatched":
            return dispatch(planned, store, lambda item: FinishedFuture(item, store), 1, lambda *_: None)
        return execute(planned, store, jobs=1, on_event=lambda *_: None)

    broken = partial(planned, b={"does": "bug"})
    last, outcome = run_to_world(broken(), broken, store, run)
    assert ran() == "abcd", "each runs once, although forced"
    assert {item.task.step.name for item in last} == outcome.of_tile().keys() == {"a", "c", "d"}
    assert outcome.of_tile()["d"].metrics == {"total": 1} and not outcome.failed
    assert "a bug" in outcome.side_failed[TaskId("b")].cause and not list((tmp_path / "store" / "b").glob("*"))
    _, outcome = run_to_world(planned(), planned, store, run)
    assert outcome.of_tile()["d"].metrics == {"total": 2} and not outcome.side_failed, "it is retried"
    with pytest.raises(DataError, match="to fail"):
        run_to_world(broken(d={"does": "fail"}), partial(broken, d={"does": "fail"}), store, run)


class CountParams(Params):
    """Counts to `to`; the process is killed at 2 unless the count started above `above`."""

    to: int = 4
    above: int = 0


def count(inputs: Inputs, params: CountParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Count, resuming from the checkpoint."""
    known = checkpoint / "known.txt"
    first = int(known.read_text(encoding="utf-8")) if known.exists() else 0
    for number in range(first, params.to):
        known.write_text(str(number + 1), encoding="utf-8")
        if number == 1 and first <= params.above:
            os.kill(os.getpid(), signal.SIGKILL)
    (out / "number.txt").write_text(str(params.to), encoding="utf-8")
    return Done({"number": out / "number.txt"}, {"began": first})


def test_killed_step_resumes_from_its_checkpoint_only_with_the_same_input(tmp_path: Path, source: Path) -> None:
    store, step = Store(tmp_path / "store"), Step("count", 1, count, CountParams, resumes=True)

    def run(**params: int) -> Manifest:
        tasks = [Task(step, CountParams(**params), {"source": source})]
        outcome = execute(plan(tasks, store), store, jobs=1, on_event=lambda *_: None)
        outcome.check()
        return outcome.of_tile()["count"]

    with pytest.raises(StepError, match="killed"):
        run()
    assert run(above=-1).metrics == {"began": 0}, "other parameters don't use the checkpoint"
    assert len(list((store.root / "count").glob(".part-*"))) == 1
    assert run().metrics == {"began": 2} and not list((store.root / "count").glob(".part-*"))
    with pytest.raises(StepError, match="killed"):
        run(to=5)
    source.write_text("another", encoding="utf-8")
    with pytest.raises(StepError, match="killed"):
        run(to=5)
    parts = list((store.root / "count").glob(".part-*"))
    assert len(parts) == 2
    store.sweep({"count": "another key"})
    assert not list((store.root / "count").iterdir())


def test_digest_of_a_folder_covers_names_and_contents(tmp_path: Path) -> None:
    folder, digests = tmp_path / "frames", Digests(tmp_path / "digests.json")
    folder.mkdir()
    (folder / "1.png").write_bytes(b"one")
    before = digest(folder)
    assert digests(folder) == before != digest(tmp_path / "absent")
    (folder / "1.png").rename(folder / "2.png")
    assert digests(folder) == digest(folder) != before


def test_file_names_of_another_encoding_have_digests_and_are_logged(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode("straße".encode("latin-1"))
    folder.mkdir()
    (folder / folder.name).write_bytes(b"photo")
    assert digest(folder) != digest(tmp_path) and digest(folder) == Digests(tmp_path / "digests.json")(folder)
    Log(tmp_path / "run.log").write(f"tile {folder}")
    assert "stra\\udcdfe" in (tmp_path / "run.log").read_text(encoding="utf-8")


def test_deleted_output_is_rebuilt_and_nothing_else(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    next((tmp_path / "store" / "b").rglob("number.txt")).unlink()
    run()
    assert ran() == "b"


def number(tmp_path: Path, name: str) -> Path:
    return next((tmp_path / "store" / name).rglob("number.txt"))


def test_changed_output_is_rebuilt_and_nothing_else(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    number(tmp_path, "b").write_text("7", encoding="utf-8")  # same number of bytes
    assert run()["d"].metrics == {"total": 2}
    assert ran() == "b" and number(tmp_path, "b").read_text(encoding="utf-8") == "1"


def test_damage_with_unchanged_size_and_time_is_found_when_read(
    run: Run, ran: Callable[[], str], tmp_path: Path
) -> None:
    run()
    ran()
    damaged = number(tmp_path, "a")
    stat = damaged.stat()
    damaged.write_text("7", encoding="utf-8")
    os.utime(damaged, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    run()
    assert ran() == "", "results that aren't read are checked by size and time only"
    assert run(c={"value": 5})["d"].metrics == {"total": 7}
    assert ran() == "acd" and number(tmp_path, "a").read_text(encoding="utf-8") == "1"


def test_copied_store_is_valid(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    shutil.copytree(tmp_path / "store", tmp_path / "copy", copy_function=shutil.copyfile)
    for file in (tmp_path / "copy").rglob("number.txt"):
        os.utime(file)
    shutil.rmtree(tmp_path / "store")
    (tmp_path / "copy").rename(tmp_path / "store")
    run()
    assert ran() == ""


def test_damaged_manifest_is_ignored(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    run()
    ran()
    path = number(tmp_path, "d").with_name("manifest.json")
    path.write_text(path.read_text(encoding="utf-8").replace('"total": 2', '"total": 3'), encoding="utf-8")
    assert run()["d"].metrics == {"total": 2}
    assert ran() == "d"


@pytest.mark.parametrize("name", ["/etc/hostname", "../../../secret.txt", "link/secret.txt", "link.txt", "a\0b"])
def test_manifest_with_paths_outside_its_folder_is_rejected(
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


def test_from_reruns_a_step_and_its_dependents(run: Run, ran: Callable[[], str]) -> None:
    run()
    ran()
    run(start="c")
    assert ran() == "cd"
    run(force=True)
    assert ran() == "abcd"


def test_failing_step_keeps_finished_results(run: Run, ran: Callable[[], str], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="configured to fail"):
        run(d={"does": "fail"})
    ran()
    assert not list((tmp_path / "store" / "d").glob("*"))
    run()
    assert ran() == "d"


def test_exceptions_and_killed_processes_become_step_errors(run: Run) -> None:
    with pytest.raises(StepError, match="a bug"):
        run(b={"does": "bug"})
    with pytest.raises(StepError, match="killed"):
        run(b={"does": "die"})


FAILED_AND_INTERRUPTED_RUNS = """
import sys
from pathlib import Path
from scan2sim.flows.engine.execution import *
from scan2sim.flows.engine.planning import *
from scan2sim.pipeline.core.errors import *
from tests.flows.toy import chain

source = Path(sys.argv[1])
for does in ("litter", "bug", "hang"):
    folder = source.with_name(does)
    folder.mkdir()
    store = Store(folder / "store")
    tasks = chain(source, folder / "log", b={"does": does}, c={"does": "hang"})
    try:
        execute(plan(tasks, store), store, jobs=2, on_event=lambda *_: None).check()
    except ScanError as error:
        print(error, file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        sys.exit("interrupted")
"""


def test_failed_or_interrupted_runs_print_only_their_messages(tmp_path: Path, source: Path) -> None:
    """One after the other in one process: a step is killed and leaves locks, one has a bug, Ctrl-C interrupts one."""
    child = subprocess.Popen(
        [sys.executable, "-c", FAILED_AND_INTERRUPTED_RUNS, str(source)], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until(lambda: child.poll() is not None or (tmp_path / "hang" / "pid_b").exists(), 180, what="a running task")
    os.killpg(child.pid, signal.SIGINT)  # as a terminal does
    printed = "".join(child.communicate())
    lines, messages = printed.splitlines(), ("was killed", "failed unexpectedly", "interrupted")
    assert len(lines) == len(messages) and "Traceback" not in printed, printed
    assert all(message in line for line, message in zip(lines, messages, strict=True)), printed


CTRL_C_WHILE_THE_SERVER_STARTS = """
import os, signal, sys, time
from multiprocessing import forkserver
from pathlib import Path
from scan2sim.flows.engine import processes

processes._fork_server()
server = forkserver._forkserver._forkserver_pid

def is_ready():
    lines = Path(f"/proc/{server}/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    if "zombie" in status["State"]:
        sys.exit("the server has died")
    return int(status["SigIgn"], 16) & 1 << signal.SIGINT - 1

while not is_ready():
    os.kill(server, signal.SIGINT)
    time.sleep(0.001)
try:
    os.killpg(0, signal.SIGINT)
    time.sleep(60)
except KeyboardInterrupt:
    sys.exit("interrupted")
"""


def test_ctrl_c_before_the_first_task_prints_no_traceback() -> None:
    command = [sys.executable, "-c", CTRL_C_WHILE_THE_SERVER_STARTS]
    child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, start_new_session=True)
    assert (child.stdout + child.stderr).strip() == "interrupted"


def test_plan_has_reasons(tmp_path: Path, source: Path, run: Run) -> None:
    run()
    store = Store(tmp_path / "store")

    def reasons(**changes: dict[str, object]) -> dict[str, Reason | None]:
        return {p.task.full_name: p.reason for p in plan(chain(source, tmp_path / "log", **changes), store)}

    assert set(reasons().values()) == {None}
    changed = reasons(b={"value": 1})
    assert changed["a"] is None and changed["c"] is None
    assert changed["b"] is Reason.CHANGED


def test_plan_names_what_changed(tmp_path: Path, source: Path, run: Run) -> None:
    run()
    store = Store(tmp_path / "store")

    def texts(**changes: dict[str, object]) -> dict[str, str]:
        return {p.task.full_name: why(p, store) for p in plan(chain(source, tmp_path / "log", **changes), store)}

    assert set(texts().values()) == {"cached: same input, settings and version"}
    changed = texts(a={"value": 7})
    assert changed["a"] == "settings changed: value 0 -> 7"
    assert changed["b"] == "input may change: reused if it turns out the same"
    source.write_text("other", encoding="utf-8")
    assert texts()["a"].startswith("input files changed: ")


def test_second_run_in_the_same_folder_is_a_busy_error(tmp_path: Path) -> None:
    with locked(tmp_path / "out"), pytest.raises(BusyError, match="another run"), locked(tmp_path / "out"):
        pass


def test_sigkill_leaves_no_partial_result_and_no_process(tmp_path: Path, source: Path, run: Run) -> None:
    script = (
        "from pathlib import Path; from scan2sim.flows.engine.execution import *\n"
        "from scan2sim.flows.engine.planning import plan; from tests.flows.toy import chain\n"
        "from tests.flows.fork_server import load_only; load_only('tests.flows.toy')\n"
        f"p = Path({str(tmp_path)!r}); s = Store(p / 'store')\n"
        "planned = plan(chain(p / 'source.txt', p / 'log', b={'does': 'hang'}), s)\n"
        "execute(planned, s, jobs=1, on_event=lambda *_: None)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
    log = tmp_path / "log"
    file = tmp_path / "pid_b"
    hanging = until(lambda: file.exists() and file.read_text(encoding="utf-8"), what="a running task")
    child.send_signal(signal.SIGKILL)
    child.wait()
    store = Store(tmp_path / "store")
    kept = {p.task.full_name: p.reason for p in plan(chain(source, log), store)}
    assert kept["a"] is None and kept["b"] is not None
    assert run()["d"].metrics == {"total": 2}
    assert hanging != file.read_text(encoding="utf-8"), "the second run is another process"
    until(lambda: not Path(f"/proc/{hanging}").exists(), what="the end of the hanging task")


def test_versions_include_all_packages_that_steps_use(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"], *(f'{one}; extra == "{name}"' for name in extras for one in extras[name])]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: lines)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: f"1 of {name}")
    found = versions.__wrapped__()
    computing = {"numpy", "numba", "scipy", "pyproj", "torch", "onnxruntime", "pycolmap", "opencv-python-headless"}
    computing |= {package for package, extra in EXTRA_OF.items() if extra not in EXTRAS_WITHOUT_STEPS} - {
        "pxr",
        "kiss_icp",
        "pillow_heif",
    }
    computing |= {"usd-core", "kiss-icp", "pillow-heif"}
    assert computing <= found.keys()
    assert found["scan2sim"] == scan2sim.__version__ and not {"prefect", "ray", "s3fs", "pytest"} & found.keys()


def test_worker_with_another_numba_is_rejected_but_missing_extras_are_allowed(tmp_path: Path, source: Path) -> None:
    task = plan(chain(source, tmp_path / "log"), Store(tmp_path / "store"))[0]
    check_version(task, dict(versions()) | {"a-package-of-an-extra": "1"})
    with pytest.raises(UnavailableError, match=r"numba .* instead of 0\.1"):
        check_version(task, dict(versions()) | {"numba": "0.1"})


def test_versions_without_package_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", none)
    assert versions.__wrapped__() == {"python": sys.version.split()[0], "scan2sim": scan2sim.__version__}


SCRIPT = """
import os, sys
from pathlib import Path

sys.path[:0] = [{root!r}]
sys.path.append(Path("no text, so Python skips it"))

from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import plan
from scan2sim.pipeline.core.cache import Store
from tests.flows.toy import chain

before = dict(os.environ), sys.warnoptions[:], [*sys.path]
folder, store = Path({folder!r}), Store(Path({folder!r}) / "store")
print("runs", flush=True)
outcome = execute(plan(chain(Path({source!r}), folder / "log"), store), store, jobs=2, on_event=lambda *_: None)
outcome.check()
print("total", outcome.of_tile()["d"].metrics["total"])
print("unchanged" if before == (dict(os.environ), sys.warnoptions, sys.path) else "changed")
"""


def test_a_script_beside_neither_its_packages_nor_its_data(source: Path, tmp_path: Path) -> None:
    """As `scan2sim.run` is used, without a guard of the main part: steps' processes must not run the script again.

    The script finds the package by `sys.path`, and the folder of the data has a module named as one of Python's own.
    """
    data, script = tmp_path / "data", tmp_path / "scripts" / "my_script.py"
    for folder in (data, script.parent):
        folder.mkdir()
    (data / "random.py").write_text("raise SystemExit('shadowed')", encoding="utf-8")
    text = SCRIPT.format(root=str(ROOT), folder=str(tmp_path), source=str(source))
    script.write_text(text, encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    done = subprocess.run([sys.executable, script], cwd=data, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["runs", "total", "2", "unchanged"]


def test_steps_run_where_the_path_of_the_temporary_folder_is_too_long_for_sockets(source: Path, tmp_path: Path) -> None:
    folder, script = tmp_path / ("job" * 30), tmp_path / "my_script.py"
    folder.mkdir()
    script.write_text(SCRIPT.format(root=str(ROOT), folder=str(tmp_path), source=str(source)), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, env=os.environ | {"TMPDIR": str(folder)}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["runs", "total", "2", "unchanged"]
    assert not list(folder.iterdir())
