"""Damaged files: a sentence and an exit code of the table, or a reading of them; no traceback, soon, in bounds.

A failure names kind and seed: `python -m tests.fuzz --first SEED --cases 1 KIND` shows it again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.harness import Child, fuzz
from tests.fuzz.kinds import KINDS

FEW, MANY = 12, 250
"""Cases a kind, in `make test` and `make test-all`."""


@pytest.fixture(scope="module")
def child() -> Iterator[Child]:
    child = Child()
    yield child
    child.close()


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_refused_or_read(kind: str, child: Child, tmp_path: Path) -> None:
    tally = fuzz(kind, range(FEW), tmp_path / "x", child)
    assert not tally.failures, "\n".join(tally.failures)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_them(kind: str, child: Child, tmp_path: Path) -> None:
    tally = fuzz(kind, range(FEW, FEW + MANY), tmp_path / "x", child)
    assert not tally.failures, "\n".join(tally.failures)
