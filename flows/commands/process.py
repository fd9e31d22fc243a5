"""Prepares the process of a command for what some shells, services and containers start it with."""

from __future__ import annotations

import io
import os
import resource
import sys
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError

OPEN_FILES = 8192
"""Files that a command may have open: macOS permits 256, many Linux systems 1024."""


def open_standard_streams() -> None:
    """Open those of standard input, output and error that are closed (`<&-`): other files would get their numbers."""
    for _ in range(3):
        number = os.open(os.devnull, os.O_RDWR)
        if number > 2:
            os.close(number)
            return
        os.set_inheritable(number, True)


def replace_unencodable_characters() -> None:
    """Print `?` for characters that the terminal's encoding (such as Latin-1) doesn't have, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def raise_file_limit() -> None:
    """Raise this process's limit of open files to `OPEN_FILES`, as far as the hard limit permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))


def check_current_folder() -> None:
    """Check that the current folder exists: no process could be started.

    Raises:
        InputError: it was deleted.
    """
    try:
        Path.cwd()
    except FileNotFoundError:
        raise InputError("the current folder", "was deleted", "Change to a folder that exists") from None
