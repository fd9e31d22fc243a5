"""Pages are opened on desktops only: a browser for terminals would wait for a page that isn't served yet."""

from __future__ import annotations

import pytest

from scan2sim.flows.commands.browser import open_page


@pytest.mark.parametrize(
    ("platform", "displays", "opened"),
    [("linux", {}, False), ("linux", {"DISPLAY": ":0"}, True), ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
     ("darwin", {}, True)],
)  # fmt: skip
def test_pages_are_opened_on_desktops_only(
    platform: str, displays: dict[str, str], opened: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    addresses: list[str] = []
    monkeypatch.setattr("webbrowser.open", addresses.append)
    monkeypatch.setattr("sys.platform", platform)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, displays.get(name, ""))
    open_page("http://localhost:8000/")
    assert addresses == ["http://localhost:8000/"] * opened
