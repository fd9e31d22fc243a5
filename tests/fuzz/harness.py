"""Damaged files through the readers: what must hold of each, whatever it is.

`python -m tests.fuzz --cases 300` prints a line a kind, and all failures.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import time
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
CODES = {0, *(code for code, _, _ in EXIT_CODES.values())}
SECONDS, MEGABYTES = 10.0, 2000.0
"""Bounds of a case. The memory is the whole process's, libraries included."""
START = 120.0
"""Seconds for a child to start and to read something whole, on a busy machine."""


@dataclass(frozen=True)
class Outcome:
    """What became of a case: the exit code (None: the process died, or took too long), what was said, what it cost."""

    code: int | None
    said: str
    seconds: float
    mb: float = 0.0

    @property
    def wrong(self) -> str:
        """What must not be, or nothing."""
        if self.code not in CODES:
            return f"exit code {self.code}: {self.said}"
        if self.seconds > SECONDS or self.mb > MEGABYTES:
            return f"{self.seconds:.1f} s, {self.mb:.0f} MB: {self.said}"
        return "" if self.code == 0 or len(self.said) > 20 else f"says only {self.said!r}"


class Child:
    """A process that reads what it is told to."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, kind: str, folder: Path, limit: float = SECONDS + 5) -> Outcome:
        """Have it read a kind from a folder."""
        process, fresh = self._process, self._process is None
        if process is None:
            command = [sys.executable, "-c", "from tests.fuzz.child import main; main()"]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
            self._process = process
        assert process.stdin and process.stdout
        began = time.perf_counter()
        process.stdin.write(json.dumps({"kind": kind, "folder": str(folder)}) + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], START if fresh else limit)
        answer = process.stdout.readline() if ready else ""
        seconds = time.perf_counter() - began
        if not answer:
            self.close()
            return Outcome(None, f"died ({process.returncode})" if ready else "took too long", seconds)
        return Outcome(seconds=seconds, **json.loads(answer))

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@dataclass
class Tally:
    """What became of a kind's cases."""

    codes: Counter[int | None] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0
    mb: float = 0.0


def fuzz(kind: str, seeds: range, folder: Path, child: Child) -> Tally:
    """Read a kind whole, then once damaged for every seed; files are as they were afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    files = KINDS[kind].make(folder)
    tally = Tally()
    whole = child.read(kind, folder, START)
    assert whole.code == 0, f"{kind} can't be read whole: {whole.said}"
    for seed, path, data in _cases(kind, seeds, files):
        good = path.read_bytes()
        path.write_bytes(data)
        outcome = child.read(kind, folder)
        path.write_bytes(good)
        if child._process is None:  # the next one begins with its imports
            child.read(kind, folder, START)
        tally.codes[outcome.code] += 1
        tally.seconds, tally.mb = max(tally.seconds, outcome.seconds), max(tally.mb, outcome.mb)
        if outcome.wrong:
            tally.failures.append(f"{kind}, seed {seed}, {path.name}: {outcome.wrong}")
    return tally


def _cases(kind: str, seeds: range, files: list[Path]) -> Iterator[tuple[int, Path, bytes]]:
    """Seed, file and what it holds then."""
    special = KINDS[kind].special
    for seed in seeds:
        rng = Random(zlib.crc32(kind.encode()) + seed)
        path = rng.choice(files)
        data = path.read_bytes()
        yield seed, path, special(data, rng) if special and rng.random() < 0.5 else damaged(data, rng)
