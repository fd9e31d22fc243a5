"""Cores that a process may use in containers and jobs with a CPU limit."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.pipeline.core import cores


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".", 1)).write_text(text, encoding="utf-8")


@pytest.fixture
def membership(tmp_path: Path) -> Path:
    """List of a process's groups in versions 2 and 1."""
    path = tmp_path / "membership"
    path.write_text("3:cpu,cpuacct:/docker/12ab\n2:memory:/docker/12ab\n0::/job.slice/step.scope\n", encoding="utf-8")
    return path


def test_a_container_with_a_cpu_limit_has_as_many_cores(tmp_path: Path, membership: Path) -> None:
    def limit() -> int | None:
        return cores.cpu_limit(tmp_path, membership)

    assert limit() is None
    write(tmp_path, cpu_max="max 100000\n")
    assert limit() is None
    write(tmp_path, cpu_max="250000 100000\n")
    assert limit() == 3
    write(tmp_path / "job.slice", cpu_max="200000 100000\n")
    assert limit() == 2, "the limit of a group holds for those in it"
    write(tmp_path / "job.slice" / "step.scope", cpu_max="1000 100000\n")
    assert limit() == 1


def test_cpu_limit_of_version_1(tmp_path: Path, membership: Path) -> None:
    write(tmp_path / "cpu", cpu_cfs_quota_us="-1\n", cpu_cfs_period_us="100000\n")
    assert cores.cpu_limit(tmp_path, membership) is None
    write(tmp_path / "cpu", cpu_cfs_quota_us="400000\n")
    assert cores.cpu_limit(tmp_path, membership) == 4


def test_unknown_limits_are_none(tmp_path: Path) -> None:
    assert cores.cpu_limit(tmp_path, tmp_path / "none") is None
    write(tmp_path, cpu_max="what?")
    assert cores.cpu_limit(tmp_path, tmp_path / "none") is None


def test_libraries_start_no_more_threads_than_the_container_has_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {"OMP_NUM_THREADS": "1"}
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(128)))
    for limit, expected in ((None, None), (2, "2")):
        monkeypatch.setattr(cores, "cpu_limit", lambda limit=limit: limit)
        cores.limit_threads(environment)
        assert cores.available_cores() == (limit or 128)
        assert environment.get("NUMBA_NUM_THREADS") == expected and environment["OMP_NUM_THREADS"] == "1"
