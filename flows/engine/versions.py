"""Versions of all that results depend on: told in reports, and compared between a flow and its workers."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache

from scan2sim import __version__
from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.pipelines.steps import STEPS
from scan2sim.pipeline.core.errors import UnavailableError

APART = ("flows", "ray", "s3", "bus", "orchestration", "toolboxes", "teleop", "can", "dev")
"""Extras that hand work out, bring files, watch, serve or try the project: no step depends on their packages."""


@cache
def versions() -> Mapping[str, str]:
    """Versions of Python, the project and what it computes with, as far as that is installed."""
    found = {"python": sys.version.split()[0], "scan2sim": __version__}
    with suppress(importlib.metadata.PackageNotFoundError):
        for line in importlib.metadata.requires("scan2sim") or ():
            extra = re.search(r"extra == ['\"]([\w-]+)", line)
            if extra is None or extra[1] not in APART:
                name = re.split(r"[^\w.-]", line)[0]
                with suppress(importlib.metadata.PackageNotFoundError):
                    found[name] = importlib.metadata.version(name)
    return found


def check_version(item: Planned, wanted: Mapping[str, str]) -> None:
    """Refuse to run a node with other code than the flow's that planned it.

    Args:
        wanted: the flow's `versions()`; what isn't installed here is left to the steps, which say what they lack.

    Raises:
        UnavailableError: this machine has another version of the project, of the step, or of what computes it.
    """
    mine, name = versions(), item.node.step.name
    others = [f"{k} {mine[k]} instead of {v}" for k, v in wanted.items() if mine.get(k, v) != v]
    local = next((step.version for step in STEPS if step.name == name), item.node.step.version)
    if local != item.node.step.version:
        others.append(f"version {local} of step {name} instead of {item.node.step.version}")
    if others:
        remedy = "Install the same version on all workers as where the flow runs, and start them again"
        raise UnavailableError(platform.node(), f"this worker has {', '.join(others)}", remedy)
