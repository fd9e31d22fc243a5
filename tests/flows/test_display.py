"""Progress bars on narrow terminals, and runs that print nothing."""

from __future__ import annotations

import io
from threading import Event, Thread

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


def test_a_quiet_run_silences_neither_runs_in_other_threads_nor_those_after_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As two threads of a program that call `scan2sim.run`, whose runs overlap."""
    first_began, second_began, first_ended = Event(), Event(), Event()

    def first() -> None:
        with display.shown(False):
            first_began.set()
            second_began.wait()
            display.warn("of the first")
        first_ended.set()

    def second() -> None:
        first_began.wait()
        with display.shown(True):
            second_began.set()
            first_ended.wait()
            display.warn("of the second")

    threads = [Thread(target=first), Thread(target=second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    display.warn("afterwards")
    printed = capsys.readouterr().out
    assert "of the first" not in printed and "of the second" in printed and "afterwards" in printed


def test_a_quiet_run_has_no_progress_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display.console, "_force_terminal", True)
    assert not display._progress().disable
    with display.shown(False):
        assert display._progress().disable
