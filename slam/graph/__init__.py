"""The graph of cameras and points, and what solves it: one file a backend, found by its name."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from scan2sim.pipeline.errors import SettingError

if TYPE_CHECKING:
    from scan2sim.slam.graph.problem import Backend

BACKENDS = ("lm", "adam")


def backend_named(name: str) -> Backend:
    """The module `slam.graph.<name>`.

    Raises:
        SettingError: there is none.
    """
    if name not in BACKENDS:
        raise SettingError("backend", f"there is no `{name}`", f"Choose one of {', '.join(BACKENDS)}")
    return import_module(f"scan2sim.slam.graph.{name}")  # type: ignore[return-value]
