"""Temporary files without a name, in memory: the folder for temporary files may be small, full or missing."""

from __future__ import annotations

import ctypes
import os
import tempfile
from typing import IO

MFD_CLOEXEC = 1


def anonymous_file() -> IO[bytes]:
    """An empty file to write and read; on disk where there are none in memory (macOS).

    Called through the C library, as `os.memfd_create` is missing in Pythons that are built for old systems: those of
    conda and uv.
    """
    create = getattr(ctypes.CDLL(None), "memfd_create", None)
    file = -1 if create is None else create(b"scan2sim", MFD_CLOEXEC)
    return tempfile.TemporaryFile() if file < 0 else os.fdopen(file, "w+b")
