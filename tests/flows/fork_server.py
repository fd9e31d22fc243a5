"""Fork servers that load only what the steps of a test need."""

from __future__ import annotations

import multiprocessing


def load_only(*modules: str) -> None:
    """Make fork servers that this process starts load these modules instead of the libraries of real steps."""
    context = multiprocessing.get_context("forkserver")
    preload = context.set_forkserver_preload
    loaded = ["scan2sim.flows.engine.processes", *modules]
    context.set_forkserver_preload = lambda module_names: preload(loaded)  # type: ignore[method-assign]
