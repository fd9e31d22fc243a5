"""Run the tests of `make test`: in parallel, then those in real time one at a time, then those that failed once more.

    python -m tests.suite [-m MARKERS] [--report FILE] [options of pytest]

The kernels of a fresh checkout are compiled first. Tests with the marker `realtime` depend on a real clock (limits of
seconds, DDS, Chromium, several programs): others at the same time would slow them down. Tests that failed run once
more, alone. The run passes if at most `PASSED_ALONE_MAX` failed and all of these pass alone; they are listed with their
first failure, to be fixed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests import kernels

# without reordering, as the longest files, which have few tests, would run last
PARALLEL = ("-n", "3", "--dist", "loadfile", "--no-loadscope-reorder")
PASSED_ALONE_MAX = 3
"""Maximum number of tests that failed under load and passed alone in a run that passes."""
RETRIED_MAX = 30
"""With more failures than this, the cause isn't chance, and none runs again."""
SLOWEST_FILES = 10
"""Number of files in the list of the slowest."""
STOPPED = (pytest.ExitCode.INTERRUPTED, pytest.ExitCode.INTERNAL_ERROR, pytest.ExitCode.USAGE_ERROR)
COMPLETE = (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED)


@dataclass(frozen=True)
class Run:
    """Result of a run of pytest.

    Attributes:
        status: pytest's exit status.
        tests: number of tests that ran.
        failures: message of the first failure by test ID.
        seconds: wall time by test file, set-up included.
    """

    name: str
    status: int
    minutes: float
    tests: int
    failures: dict[str, str]
    seconds: Counter[str]


def main() -> int:
    """Run the tests; returns the exit status."""
    # where it is set, as in many containers, each of about a thousand processes would compile all modules again
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as in the processes of steps: workers share the cores
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads always wait actively
    parser = argparse.ArgumentParser(prog="python -m tests.suite", description=__doc__, add_help=False)
    parser.add_argument("-m", dest="markers", default="not slow")
    parser.add_argument("--report", type=Path)
    known, options = parser.parse_known_args()
    compiled = Path.cwd() != kernels.ROOT or kernels.are_compiled() or compile_kernels()
    runs = [run_pytest("parallel", "-m", f"({known.markers}) and not realtime", *PARALLEL, *options)]
    if runs[0].status not in STOPPED:
        files = () if any(Path(option.split("::")[0]).exists() for option in options) else files_in_real_time()
        runs.append(run_pytest("real time", "-m", f"({known.markers}) and realtime", *files, *options))
    failures = {test: message for run in runs for test, message in run.failures.items()}
    again = run_pytest("failed, alone", *failures) if 0 < len(failures) <= RETRIED_MAX else None
    status = exit_status(runs, failures, again)
    print_summary([*runs, again] if again else runs, failures, again, status)
    if not compiled:
        print("failed: the worlds that compile the kernels can't be made (python -m tests.kernels)")
        status = status or int(pytest.ExitCode.TESTS_FAILED)
    if known.report:
        report = {
            "status": status,
            "failed": failures,
            "failed_alone": sorted(again.failures) if again else [],
            "minutes": {run.name: run.minutes for run in runs},
            "tests": {run.name: run.tests for run in runs},
            "seconds": {run.name: dict(run.seconds.most_common()) for run in runs},
        }
        known.report.write_text(json.dumps(report, indent=2), encoding="utf-8")
    return status


def compile_kernels() -> bool:
    """Compile the kernels of a fresh checkout; returns whether the worlds that use them could be made."""
    print("compiling kernels ...", flush=True)
    return subprocess.run([sys.executable, "-m", "tests.kernels"]).returncode == 0


def files_in_real_time() -> list[str]:
    """Test files that name the marker `realtime`: collecting all the others takes a minute."""
    folder = Path("tests") if Path("tests").is_dir() else Path()
    return sorted(str(file) for file in folder.rglob("test_*.py") if "realtime" in file.read_text(encoding="utf-8"))


def run_pytest(name: str, *options: str) -> Run:
    """Run pytest with these options in a process of its own."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "reports.jsonl"
        status = subprocess.run([sys.executable, "-m", "pytest", f"--report-log={log}", *options]).returncode
        reports = list(read_reports(log))
    failures: dict[str, str] = {}
    seconds: Counter[str] = Counter()
    for report in reports:
        seconds[report["nodeid"].split("::")[0]] += report.get("duration", 0.0)
        if report["outcome"] == "failed":
            failures.setdefault(report["nodeid"], failure_message(report["longrepr"]))
    tests = sum(report.get("when") == "call" for report in reports)
    return Run(name, status, (time.monotonic() - began) / 60, tests, failures, seconds)


def read_reports(log: Path) -> Iterator[dict[str, Any]]:
    """Reports of tests and of collection in a file of pytest-reportlog."""
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else ():
        if (report := json.loads(line)).get("$report_type") in ("TestReport", "CollectReport"):
            yield report


def failure_message(representation: Any) -> str:
    """The exception's message in pytest-reportlog's representation of a failure."""
    if isinstance(representation, dict) and representation.get("reprcrash"):
        crash = representation["reprcrash"]
        return f"{crash['path']}:{crash['lineno']}: {crash['message']}"
    return str(representation)


def exit_status(runs: list[Run], failures: dict[str, str], again: Run | None) -> int:
    """Exit status of all runs: 0 if everything passed, apart from a few failures that passed alone."""
    if incomplete := [run.status for run in runs if run.status not in COMPLETE]:
        return incomplete[0]
    if all(run.status == pytest.ExitCode.NO_TESTS_COLLECTED for run in runs):
        return pytest.ExitCode.NO_TESTS_COLLECTED
    passed_alone = again is not None and again.status == pytest.ExitCode.OK and len(failures) <= PASSED_ALONE_MAX
    failed = any(run.status == pytest.ExitCode.TESTS_FAILED for run in runs)
    return pytest.ExitCode.TESTS_FAILED if failed and not passed_alone else pytest.ExitCode.OK


def print_summary(runs: list[Run], failures: dict[str, str], again: Run | None, status: int) -> None:
    """Print the minutes of each run, and which tests failed under load or twice."""
    twice = set(again.failures) if again else set(failures)
    for title, tests in (
        (
            "failed under load, passed alone: fix these before anything else",
            [one for one in failures if one not in twice],
        ),
        ("failed twice" if again else "failed, too many to try each alone", [one for one in failures if one in twice]),
    ):
        if tests:
            print(f"\n{f' {title} ':=^100}")
        for test in tests:
            print(f"{test}\n    " + failures[test].strip().replace("\n", "\n    "))
    print()
    for run in runs:
        slowest = ", ".join(f"{file} {seconds:.0f} s" for file, seconds in run.seconds.most_common(SLOWEST_FILES))
        print(f"{run.name}: {run.tests} tests in {run.minutes:.1f} minutes; longest: {slowest}")
    if status == 0 and failures:
        print(f"passed; {len(failures)} of at most {PASSED_ALONE_MAX} tests failed under load and passed alone")
    elif again and again.status == 0 and len(failures) > PASSED_ALONE_MAX:
        print(f"failed: {len(failures)} tests failed under load, more than {PASSED_ALONE_MAX}")
    else:
        print("passed" if status == 0 else f"failed (exit status {int(status)})")


if __name__ == "__main__":
    sys.exit(main())
