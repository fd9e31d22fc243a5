"""Read damaged files in a child process, and check exit code, message, processor time and memory of each.

`python -m tests.fuzz --cases 300` prints a summary line per kind, and all failures.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from scan2sim.pipeline.core.errors import EXIT_CODES
from tests.fuzz.damage import damaged
from tests.fuzz.kinds import KINDS

ROOT = Path(__file__).resolve().parents[2]
VALID_CODES = {0, *(code for code, _, _ in EXIT_CODES.values())}
MAX_SECONDS, MAX_MEGABYTES = 10.0, 2000.0
"""Limits per case: processor time, and memory of the whole process, libraries included."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of the child: the files are too small for several threads."""
HANG_TIMEOUT_S = 120.0
"""A child that doesn't answer within this time hangs, even on a busy machine."""


@dataclass(frozen=True)
class Outcome:
    """Result of a case: exit code (None: the process died or hangs), error message, processor time and peak memory."""

    code: int | None
    message: str
    seconds: float = 0.0
    mb: float = 0.0

    @property
    def failure(self) -> str:
        """Reason why the outcome is not acceptable; empty if it is."""
        if self.code not in VALID_CODES:
            return f"exit code {self.code}: {self.message}"
        if self.seconds > MAX_SECONDS or self.mb > MAX_MEGABYTES:
            return f"{self.seconds:.1f} s, {self.mb:.0f} MB: {self.message}"
        return "" if self.code == 0 or len(self.message) > 20 else f"message too short: {self.message!r}"


class Child:
    """Child process that reads files on request; started again when it has died."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, kind: str, folder: Path) -> Outcome:
        """Read the files of a kind in a folder."""
        process = self._process
        if process is None:
            command = [sys.executable, "-c", "from tests.fuzz.child import main; main()"]
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
                env=os.environ | ONE_THREAD,
            )  # fmt: skip
            self._process = process
        assert process.stdin and process.stdout
        process.stdin.write(json.dumps({"kind": kind, "folder": str(folder)}) + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], HANG_TIMEOUT_S)
        answer = process.stdout.readline() if ready else ""
        if not answer:
            self.close()
            return Outcome(None, f"died ({process.returncode})" if ready else "hangs")
        return Outcome(**json.loads(answer))

    def close(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@dataclass
class Tally:
    """Outcomes of all cases of a kind: counts of exit codes, failures, maximum processor time and memory."""

    codes: Counter[int | None] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0
    mb: float = 0.0


def fuzz(kind: str, seeds: range, folder: Path, child: Child) -> Tally:
    """Read the files of a kind undamaged, then once with damage per seed; files are restored afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    files = KINDS[kind].make(folder)
    tally = Tally()
    undamaged = child.read(kind, folder)
    assert undamaged.code == 0, f"{kind} can't be read undamaged: {undamaged.message}"
    for seed, path, data in _cases(kind, seeds, files):
        good = path.read_bytes()
        path.write_bytes(data)
        outcome = child.read(kind, folder)
        path.write_bytes(good)
        if child._process is None:  # let the next process do its imports before it is timed
            child.read(kind, folder)
        tally.codes[outcome.code] += 1
        tally.seconds, tally.mb = max(tally.seconds, outcome.seconds), max(tally.mb, outcome.mb)
        if outcome.failure:
            tally.failures.append(f"{kind}, seed {seed}, {path.name}: {outcome.failure}")
    return tally


def _cases(kind: str, seeds: range, files: list[Path]) -> Iterator[tuple[int, Path, bytes]]:
    """Seeds, files and their damaged content."""
    special = KINDS[kind].special
    for seed in seeds:
        rng = Random(zlib.crc32(kind.encode()) + seed)
        path = rng.choice(files)
        data = path.read_bytes()
        yield seed, path, special(data, rng) if special and rng.random() < 0.5 else damaged(data, rng)
