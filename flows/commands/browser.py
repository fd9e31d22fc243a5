"""Opens pages in the browser of the desktop."""

from __future__ import annotations

import os
import sys
import webbrowser


def open_page(address: str) -> None:
    """Open a page, unless there is no desktop: a browser for terminals would occupy this one, and wait for the page."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(address)
