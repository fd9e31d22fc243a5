"""Run `make test` several times on a machine that is kept busy, and list the tests that fail by chance.

`python -m bench.suite [--rounds 5] [--parts quiet loaded] [--out bench-out/suite]`. The committed state is cloned into
a temporary folder with nothing beside it. Part `quiet` runs `make test` once; part `loaded` runs it in rounds beside
two busy loops, while a random process of the run is stopped for a second every ten seconds. Rounds are stored by
commit: a later call continues them, `--rounds` is their total. Ends with `RESULT {json}`:

- rounds: number of rounds under load; red_rounds: those that `make test` ended with an error.
- failed_tests: number of distinct tests that failed in any round, even if they passed when they ran once more, alone.
- minutes_quiet: minutes of `make test` without load, installation excluded.
- realtime_tests: number of tests that run one at a time.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil

from bench.paths import ROOT

PARTS = ("quiet", "loaded")
BUSY_LOOPS = 2
STALL_PERIOD_S, STALL_S = 10.0, 1.0
"""Interval between two stalls, and duration of one."""


def main() -> None:
    """Run the rounds that are missing, and print the results of all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="total number of rounds under load")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "suite")
    arguments = parser.parse_args()
    commit = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=ROOT, text=True).strip()
    out: Path = arguments.out.absolute() / commit
    out.mkdir(parents=True, exist_ok=True)
    quiet = out / "quiet.json"
    rounds = [out / f"round-{number}.json" for number in range(1, arguments.rounds + 1)]
    missing = [quiet] if "quiet" in arguments.parts else []
    missing = [one for one in missing + (rounds if "loaded" in arguments.parts else []) if not one.exists()]
    if missing:
        with tempfile.TemporaryDirectory(prefix="scan2sim-suite-") as folder:
            clone = install_clone(commit, Path(folder) / "scan2sim")
            for number, report in enumerate(missing):
                print(f"=== {report.stem} of {commit} ===", flush=True)
                run_tests(clone, report, loaded=report != quiet, seed=number)
    print(f"RESULT {json.dumps(results(quiet, sorted(out.glob('round-*.json'))))}")


def install_clone(commit: str, clone: Path) -> Path:
    """Clone a commit and install what its tests need."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    subprocess.run(["git", "checkout", "--quiet", commit], cwd=clone, check=True)
    subprocess.run(["make", ".venv/.installed-dev", ".venv-ros", ".venv-triton"], cwd=clone, check=True)
    return clone


def run_tests(clone: Path, report: Path, *, loaded: bool, seed: int) -> None:
    """Run `make test` in a clone, and write its report."""
    unfinished = report.with_suffix(".unfinished")
    with ExitStack() as stack:
        if loaded:
            for _ in range(BUSY_LOOPS):
                stack.enter_context(busy_loop())
        command = ["make", "test", f"PYTEST=--report '{unfinished}'"]
        process = subprocess.Popen(command, cwd=clone, start_new_session=True)
        stack.callback(end_session, process)
        if loaded:
            stack.enter_context(random_stalls(process.pid, random.Random(seed)))
        process.wait()
    unfinished.rename(report)


@contextmanager
def busy_loop() -> Iterator[None]:
    """Keep a core busy."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextmanager
def random_stalls(root: int, chance: random.Random) -> Iterator[None]:
    """Stop a random descendant of a process for `STALL_S` every `STALL_PERIOD_S`; not one that a test has stopped."""
    ended = threading.Event()

    def stall() -> None:
        while not ended.wait(STALL_PERIOD_S - STALL_S):
            try:
                running = psutil.Process(root).children(recursive=True)
                victim = chance.choice([one for one in running if one.status() != psutil.STATUS_STOPPED])
                victim.suspend()
            except (psutil.Error, IndexError):  # it has ended
                continue
            try:
                ended.wait(STALL_S)
            finally:
                try:
                    victim.resume()
                except psutil.Error:
                    pass

    thread = threading.Thread(target=stall, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def end_session(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its session, if it still runs."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def results(quiet: Path, rounds: list[Path]) -> dict[str, Any]:
    """Figures of all rounds stored for this commit; None where there is none."""
    reports = [json.loads(path.read_text(encoding="utf-8")) for path in rounds]
    failed = {test: message for report in reports for test, message in report["failed"].items()}
    for test, message in sorted(failed.items()):
        rounds_failed = sum(test in report["failed"] for report in reports)
        print(f"failed in {rounds_failed} of {len(reports)} rounds: {test}\n    {message.splitlines()[0][:300]}")
    undisturbed = json.loads(quiet.read_text(encoding="utf-8")) if quiet.exists() else None
    if undisturbed:
        for name, minutes in undisturbed["minutes"].items():
            print(f"without load, {name}: {undisturbed['tests'][name]} tests in {minutes:.1f} minutes")
    known = [*reports, *([undisturbed] if undisturbed else [])]
    return {
        "rounds": len(reports),
        "failed_tests": len(failed),
        "red_rounds": sum(report["status"] != 0 for report in reports),
        "minutes_quiet": sum(undisturbed["minutes"].values()) if undisturbed else None,
        "realtime_tests": known[-1]["tests"]["real time"] if known else None,
    }


if __name__ == "__main__":
    main()
