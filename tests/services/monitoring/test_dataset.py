"""Dataset files of messages: order, and errors by line."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.monitoring.event_csv import read_events


def test_events_are_read_in_order(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text("seconds,bytes\n0.0,10\n0.5,50000\n0.5,1\n", encoding="utf-8")
    assert list(read_events(tmp_path / "data.csv")) == [(0.0, 10), (0.5, 50000), (0.5, 1)]


@pytest.mark.parametrize("text", ["1,2\nx,3\n", "1,2\n3\n", "5,1\n4,1\n", "1,-2\n", "nan,2\n", "1,99999999999\n"])
def test_invalid_lines_are_reported_by_number(text: str, tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"data\.csv: line \d"):
        read_events(tmp_path / "data.csv")
