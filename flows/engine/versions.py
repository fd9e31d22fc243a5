"""Versions of the packages that results depend on: listed in reports, compared between a flow and its workers."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache

from scan2sim import __version__
from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.pipeline.core.errors import WorkerError

EXTRAS_WITHOUT_STEPS = ("flows", "ray", "s3", "bus", "broker", "orchestration", "toolboxes", "teleop", "can", "dev")
"""Extras for scheduling, transfer, monitoring, services and tests: no step depends on their packages."""


@cache
def versions() -> Mapping[str, str]:
    """Versions of Python, of the project, and of the installed packages that steps depend on."""
    found = {"python": sys.version.split()[0], "scan2sim": __version__}
    with suppress(importlib.metadata.PackageNotFoundError):
        for line in importlib.metadata.requires("scan2sim") or ():
            extra = re.search(r"extra == ['\"]([\w-]+)", line)
            if extra is None or extra[1] not in EXTRAS_WITHOUT_STEPS:
                name = re.split(r"[^\w.-]", line)[0]
                with suppress(importlib.metadata.PackageNotFoundError):
                    found[name] = importlib.metadata.version(name)
    return found


def check_version(item: PlannedTask, wanted: Mapping[str, str]) -> None:
    """Reject a task that was planned by a flow with other versions than this machine has.

    Args:
        item: the task.
        wanted: the flow's `versions()`; packages missing here are left to the steps, which report them.

    Raises:
        WorkerError: this machine has another version of the project, of the step, or of a package.
    """
    from scan2sim.flows.pipelines.steps import STEPS  # imports Numba

    mine, name = versions(), item.task.step.name
    others = [f"{k} {mine[k]} instead of {v}" for k, v in wanted.items() if mine.get(k, v) != v]
    local = next((step.version for step in STEPS if step.name == name), item.task.step.version)
    if local != item.task.step.version:
        others.append(f"version {local} of step {name} instead of {item.task.step.version}")
    if others:
        remedy = "Install the versions of the flow's machine on all workers, and restart them"
        raise WorkerError(platform.node(), f"this worker has {', '.join(others)}", remedy)
