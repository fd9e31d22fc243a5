"""Cached parts of results: reused for the same inputs, never when damaged, and removed when no longer used."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from scan2sim.pipeline.core.parts import Parts


class Work:
    """Writes `number.txt`, and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self, out: Path) -> list[Path]:
        self.times += 1
        (out / "number.txt").write_text("17", encoding="utf-8")
        return [out / "number.txt"]


@pytest.fixture
def work() -> Work:
    return Work()


def provide(tmp_path: Path, work: Work, run: str, *made_from: object, version: int = 1) -> Path:
    parts, out = Parts(tmp_path / "parts", "step", version), tmp_path / run
    out.mkdir()
    parts.provide(out, made_from, lambda: work(out))
    parts.sweep()
    return out / "number.txt"


def test_cached_part_is_hard_linked(tmp_path: Path, work: Work) -> None:
    first, second = provide(tmp_path, work, "1", "photo"), provide(tmp_path, work, "2", "photo")
    assert work.times == 1
    assert second.read_text(encoding="utf-8") == "17" and first.stat().st_ino == second.stat().st_ino


def test_part_is_recomputed_for_other_inputs_or_another_version(tmp_path: Path, work: Work) -> None:
    provide(tmp_path, work, "1", "photo")
    provide(tmp_path, work, "2", "other photo")
    provide(tmp_path, work, "3", "other photo", version=2)
    assert work.times == 3


def test_damaged_part_is_computed_again(tmp_path: Path, work: Work) -> None:
    provide(tmp_path, work, "1", "photo").write_text("18", encoding="utf-8")
    assert provide(tmp_path, work, "2", "photo").read_text(encoding="utf-8") == "17"
    assert work.times == 2


def test_part_that_disappears_while_it_is_linked_leaves_other_results_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another machine removed it, or the disk permits no further link to a file."""
    texts = iter("1234")

    def work(out: Path) -> list[Path]:
        for name in ("a.txt", "b.txt"):
            (out / name).write_text(next(texts), encoding="utf-8")
        return [out / "a.txt", out / "b.txt"]

    def run(name: str) -> list[str]:
        (tmp_path / name).mkdir()
        Parts(tmp_path / "parts").provide(tmp_path / name, [], lambda: work(tmp_path / name))
        return [(tmp_path / name / file).read_text(encoding="utf-8") for file in ("a.txt", "b.txt")]

    assert run("first") == ["1", "2"]
    link = os.link

    def link_once(source: Path, target: Path) -> None:
        if target == tmp_path / "second" / "b.txt":
            raise FileNotFoundError(source)
        link(source, target)

    monkeypatch.setattr(os, "link", link_once)
    assert run("second") == ["3", "4"]
    assert [(tmp_path / "first" / name).read_text(encoding="utf-8") for name in ("a.txt", "b.txt")] == ["1", "2"]


def test_unused_parts_are_removed(tmp_path: Path, work: Work) -> None:
    provide(tmp_path, work, "1", "photo")
    provide(tmp_path, work, "2", "other photo")
    assert len(list((tmp_path / "parts").iterdir())) == 1
