"""Number of CPU cores that this process may use: of all, those it is bound to, and the CPU limit of its container."""

from __future__ import annotations

import math
import os
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path

from scan2sim.pipeline.core import cgroups

THREAD_VARIABLES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OPENBLAS_NUM_THREADS")
"""Environment variables with the number of threads of libraries, read when they are loaded."""


def available_cores() -> int:
    """Number of cores that this process may use."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = cpu_limit()
    return bound if limit is None else min(bound, limit)


def cpu_limit(root: Path = cgroups.ROOT, membership: Path = cgroups.MEMBERSHIP) -> int | None:
    """Cores' worth of CPU time that a container may use (`docker run --cpus`), rounded up; None: no limit.

    Args:
        root, membership: as of `cgroups.folders`.
    """
    limits = []
    for folder in cgroups.folders("cpu", root, membership):
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):  # versions 2 and 1
            with suppress(OSError, ValueError):  # "max" is no limit, as is -1
                quota, period = (int(word) for name in names for word in (folder / name).read_text().split())
                limits += [max(1, math.ceil(quota / period))] if quota > 0 else []
    return min(limits, default=None)


def limit_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set `THREAD_VARIABLES` in a container with a CPU limit: libraries would start a thread for each of all cores."""
    if cpu_limit() is not None:
        for name in THREAD_VARIABLES:
            environment.setdefault(name, str(available_cores()))
