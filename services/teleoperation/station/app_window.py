"""The driver's page in a window of its own: a browser of Chromium's kind without its bars, with its own profile."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from scan2sim.pipeline.core.errors import UnavailableError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "brave-browser")
SIZE = "1280,800"
"""Pixels of the window at first."""
ENDS = 5.0
"""Seconds that it may take to close."""


def browser() -> str:
    """The program that shows it.

    Raises:
        UnavailableError: there is none, or no display.
    """
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        cause = f"needs a browser that shows one page as a window: none of {', '.join(BROWSERS)} is installed here"
        raise UnavailableError("--window", cause, "Install one, as chromium, or open the page in any browser")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        remedy = "Start it on a desktop, or open the page from a machine that has one"
        raise UnavailableError("--window", "needs a display, and there is none here", remedy)
    return found


@contextmanager
def window(url: str) -> Iterator[subprocess.Popen[bytes]]:
    """A page's window, which is closed with the block; whoever closes it before leaves the wheel.

    Raises:
        UnavailableError: there is no browser for it, or no display.
    """
    program = browser()
    with tempfile.TemporaryDirectory(prefix="scan2sim-window-", ignore_cleanup_errors=True) as profile:
        here = url.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")  # of all addresses, one's own
        flags = [f"--app={here}", f"--user-data-dir={profile}", f"--window-size={SIZE}", "--no-first-run"]
        flags += ["--no-default-browser-check", "--disable-background-networking", "--disable-sync"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium's can't be had by root
        silent = subprocess.DEVNULL
        process = subprocess.Popen([program, *flags], stdin=silent, stdout=silent, stderr=silent)
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(ENDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
