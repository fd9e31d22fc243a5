"""What solves the graph of cameras and points: a file a backend (`pipeline.core.plugins`), found by its name."""

from __future__ import annotations

from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.slam.mapping.factor_graph import Graph, Solution


class Solver(Protocol):
    """What a backend's module has."""

    def solve(self, graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
        """Cameras and points that fit best; `points` False moves cameras alone."""


def named(name: str) -> Solver:
    """A backend.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: it can't run here.
    """
    solver: Solver = plugins.find(__name__, name, "track.backend")
    return solver
