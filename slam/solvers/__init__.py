"""Solvers of the factor graph. Each backend is a module here, loaded by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.slam.factor_graph import Graph, Solution


class Solver(Protocol):
    """Interface of a backend's module."""

    def solve(self, graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
        """Optimize cameras and points; with `points` False, points are fixed. `iterations` None: the default."""


def named(name: str) -> Solver:
    """Load the solver backend of a name.

    Raises:
        SettingError: there is no such backend.
        UnavailableError: a package that it needs isn't installed.
    """
    solver: Solver = plugins.find(__name__, name, "track.backend")
    return solver
