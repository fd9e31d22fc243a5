"""The driver page in its own window: a Chromium-based browser without toolbars, with a temporary profile."""

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
WINDOW_SIZE_PX = "1280,800"
"""Initial width and height of the window."""
CLOSE_TIMEOUT_S = 5.0
"""Time the browser may take to exit before it is killed."""


def browser() -> str:
    """Find a browser program.

    Raises:
        UnavailableError: none is installed, or there is no display.
    """
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        cause = f"needs a browser that can show a page in its own window; none of {', '.join(BROWSERS)} is installed"
        raise UnavailableError("--window", cause, "Install one, such as chromium, or open the page in any browser")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        remedy = "Start the command on a desktop, or open the page from another machine"
        raise UnavailableError("--window", "needs a display, and this machine has none", remedy)
    return found


@contextmanager
def window(url: str) -> Iterator[subprocess.Popen[bytes]]:
    """Show a page in its own window, closed with the block; closing it earlier releases the control lock.

    Raises:
        UnavailableError: no browser is installed, or there is no display.
    """
    program = browser()
    with tempfile.TemporaryDirectory(prefix="scan2sim-window-", ignore_cleanup_errors=True) as profile:
        local_url = url.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")  # wildcard to loopback
        flags = [
            f"--app={local_url}", f"--user-data-dir={profile}", f"--window-size={WINDOW_SIZE_PX}", "--no-first-run",
        ]  # fmt: skip
        flags += ["--no-default-browser-check", "--disable-background-networking", "--disable-sync"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium's sandbox is not available to root
        devnull = subprocess.DEVNULL
        process = subprocess.Popen([program, *flags], stdin=devnull, stdout=devnull, stderr=devnull)
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(CLOSE_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
