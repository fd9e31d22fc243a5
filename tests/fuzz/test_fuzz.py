"""Damaged files are read, or rejected with a message and a documented exit code, within time and memory limits.

A failure names kind and seed: `python -m tests.fuzz --first SEED --cases 1 KIND` reproduces it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.harness import Child, fuzz
from tests.fuzz.kinds import KINDS

FAST_CASES, SLOW_CASES = 12, 250
"""Cases per kind in `make test`, and further ones in `make test-all`."""


@pytest.fixture(scope="module")
def child() -> Iterator[Child]:
    child = Child()
    yield child
    child.close()


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_rejected(kind: str, child: Child, tmp_path: Path) -> None:
    tally = fuzz(kind, range(FAST_CASES), tmp_path / "x", child)
    assert not tally.failures, "\n".join(tally.failures)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_are_read_or_rejected(kind: str, child: Child, tmp_path: Path) -> None:
    tally = fuzz(kind, range(FAST_CASES, FAST_CASES + SLOW_CASES), tmp_path / "x", child)
    assert not tally.failures, "\n".join(tally.failures)
