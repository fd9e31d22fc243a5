"""Temporary files in memory: on every Python for Linux, and on disk where the system has none."""

from __future__ import annotations

import ctypes
import os
from types import SimpleNamespace
from typing import IO

import pytest

from scan2sim.pipeline.core.anonymous_file import anonymous_file


def assert_keeps_what_is_written(file: IO[bytes]) -> None:
    with file:
        file.write(b"text")
        file.seek(0)
        assert file.read() == b"text"


def test_files_are_in_memory_with_a_python_for_old_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create", raising=False)
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    assert_keeps_what_is_written(anonymous_file())


@pytest.mark.parametrize("libc", [SimpleNamespace(), SimpleNamespace(memfd_create=lambda name, flags: -1)])
def test_files_are_on_disk_where_the_system_has_none_in_memory(
    libc: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: libc)
    assert_keeps_what_is_written(anonymous_file())
