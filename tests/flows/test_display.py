"""Progress bars on narrow terminals."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from scan2sim.flows.commands import display


@pytest.mark.parametrize("width", [80, 120])
def test_long_message_does_not_shrink_the_progress_bar(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display, "console", Console(file=io.StringIO(), width=width, force_terminal=True))
    bars = display._progress()
    bars.add_task("poisson.vegetation", total=1, completed=1, message="photos/panorama_000123.jpg " * 9)
    shown = Console(file=io.StringIO(), width=width)
    shown.print(bars.get_renderable())
    text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("━") == 28 and "photos/pan" in text and len(text.splitlines()) == 1
