"""`make test`: failures are tried again alone, and a failure by chance is listed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

FAILS_ONCE = """
    from pathlib import Path
    mark = Path("failed-{number}")
    if not mark.exists():
        mark.touch()
        raise TimeoutError("a thread was late")
"""
MARKERS = """[pytest]
addopts = -p xdist.plugin -p pytest_reportlog.plugin
markers =
    slow
    realtime
"""
"""Without the plugins of installed packages, which take seconds to import."""


def make_tests(folder: Path, **bodies: str) -> None:
    """Write a file for each test; a name that begins with `realtime` gets this marker."""
    (folder / "pytest.ini").write_text(MARKERS)
    for name, body in bodies.items():
        marker = "@pytest.mark.realtime\n" if name.startswith("realtime") else ""
        (folder / f"test_{name}.py").write_text(f"import pytest\n{marker}def test_{name}():\n{body}")


def run_suite(folder: Path, *options: str) -> tuple[int, str, dict[str, object]]:
    """Run the suite in a folder: exit status, output and report."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "tests.suite", "--report", "report.json", *options],
        cwd=folder, capture_output=True, text=True,
        env=env | {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )  # fmt: skip
    report = folder / "report.json"
    return done.returncode, done.stdout + done.stderr, json.loads(report.read_text()) if report.exists() else {}


def test_test_that_passes_alone_is_listed_with_its_first_failure_and_the_run_passes(tmp_path: Path) -> None:
    make_tests(tmp_path, good="    pass\n", chance=FAILS_ONCE.format(number=0))
    status, output, report = run_suite(tmp_path)
    assert status == 0
    listed = output.split("failed under load, passed alone")[1]
    assert "test_chance.py::test_chance" in listed and "TimeoutError: a thread was late" in listed
    assert list(report["failed"]) == ["test_chance.py::test_chance"] and report["failed_alone"] == []  # type: ignore[call-overload]


def test_test_that_fails_twice_fails_the_run(tmp_path: Path) -> None:
    make_tests(tmp_path, good="    pass\n", wrong="    assert 1 == 2\n", chance=FAILS_ONCE.format(number=0))
    status, output, report = run_suite(tmp_path)
    assert status == pytest.ExitCode.TESTS_FAILED and report["failed_alone"] == ["test_wrong.py::test_wrong"]
    assert "test_wrong.py::test_wrong" in output.split("failed twice")[1]
    assert "test_wrong" not in output.split("failed under load, passed alone")[1].split("failed twice")[0]


def test_more_failures_than_allowed_fail_the_run_although_each_passes_alone(tmp_path: Path) -> None:
    make_tests(tmp_path, **{f"chance_{number}": FAILS_ONCE.format(number=number) for number in range(4)})
    status, output, report = run_suite(tmp_path)
    assert status == pytest.ExitCode.TESTS_FAILED and report["failed_alone"] == []
    assert "4 tests failed under load, more than 3" in output


def test_realtime_tests_run_after_the_others_in_one_process(tmp_path: Path) -> None:
    body = "    import os; print(os.environ.get('PYTEST_XDIST_WORKER'), file=open('{name}', 'w'))\n"
    make_tests(tmp_path, parallel=body.format(name="p"), realtime_one=body.format(name="r"))
    status, _, report = run_suite(tmp_path)
    assert status == 0 and report["tests"] == {"parallel": 1, "real time": 1}
    assert (tmp_path / "p").read_text().startswith("gw") and (tmp_path / "r").read_text() == "None\n"


def test_crash_of_a_worker_is_a_failure_of_its_test(tmp_path: Path) -> None:
    crash = "    import os; os._exit(3)\n"
    make_tests(tmp_path, good="    pass\n", crash=crash)
    status, output, _ = run_suite(tmp_path)
    assert status != 0 and "test_crash.py::test_crash" in output


def test_errors_of_set_up_and_collection_fail_the_run(tmp_path: Path) -> None:
    make_tests(tmp_path, good="    pass\n")
    (tmp_path / "test_broken.py").write_text("import no_such_module\n")
    status, output, _ = run_suite(tmp_path)
    assert status != 0 and "no_such_module" in output
    (tmp_path / "test_broken.py").write_text("import pytest\n@pytest.fixture\ndef x(): 1 / 0\ndef test_x(x): pass\n")
    status, output, _ = run_suite(tmp_path)
    assert status == pytest.ExitCode.TESTS_FAILED and "ZeroDivisionError" in output.split("failed twice")[1]


def test_options_select_tests_and_an_empty_selection_is_reported(tmp_path: Path) -> None:
    make_tests(tmp_path, good="    pass\n", wrong="    assert 0\n", realtime_wrong="    assert 0\n")
    assert run_suite(tmp_path, "-k", "good")[0] == 0
    assert run_suite(tmp_path, "-m", "slow")[0] == pytest.ExitCode.NO_TESTS_COLLECTED
