"""Threads of OpenBLAS: one is fastest for the small dense systems of SLAM.

NumPy and SciPy each bring an OpenBLAS, whose threads wait actively for the next call: with two of them, a system of 150
unknowns takes 40 times the processor time. The environment variable OPENBLAS_NUM_THREADS is only read when they are
loaded. Only Linux is supported; elsewhere the number of threads stays as it is.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LOADED = Path("/proc/self/maps")
"""List of the libraries that this process has loaded."""
AFFIXES = (("", ""), ("", "64_"), ("scipy_", ""), ("scipy_", "64_"))
"""Prefixes and suffixes of OpenBLAS's function names, by build."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit each OpenBLAS that is loaded to one thread until the context ends; also as a decorator."""
    import scipy.linalg  # noqa: F401 (loads both)

    before = [(library, function(library, "get")()) for library in _libraries()]
    for library, _ in before:
        function(library, "set")(1)
    try:
        yield
    finally:
        for library, threads in before:
            function(library, "set")(threads)


def function(library: ctypes.CDLL, kind: str) -> Any:
    """OpenBLAS's function that gets or sets its number of threads (`kind`: "get" or "set"); None: not an OpenBLAS."""
    names = (f"{prefix}openblas_{kind}_num_threads{suffix}" for prefix, suffix in AFFIXES)
    return next((getattr(library, name) for name in names if hasattr(library, name)), None)


def _libraries() -> list[ctypes.CDLL]:
    """All loaded OpenBLAS libraries."""
    if not LOADED.is_file():
        return []
    lines = LOADED.read_text(encoding="utf-8", errors="replace").splitlines()
    paths = dict.fromkeys(line.split(maxsplit=5)[5] for line in lines if "openblas" in line.rpartition("/")[2])
    loaded = [ctypes.CDLL(path) for path in paths]
    return [library for library in loaded if function(library, "get") and function(library, "set")]
