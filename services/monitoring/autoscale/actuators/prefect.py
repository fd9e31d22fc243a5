"""Actuator for the workers of a Prefect work pool, which run the flows of tiles and surveys (docs/deploy.md)."""

from __future__ import annotations

import sys

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.monitoring.autoscale.actuators.replicas import ProgramReplicas


class PrefectWorkers(ProgramReplicas):
    """Processes `prefect worker start` that run one flow at a time each; PREFECT_API_URL names the server."""

    def __init__(self, pool: str) -> None:
        """`pool`: name of an existing work pool.

        Raises:
            UnavailableError: Prefect isn't installed.
        """
        optional_deps.require("workers of a Prefect pool", "prefect")
        start = ["worker", "start", "--pool", pool, "--limit", "1", "--no-create-pool-if-not-found"]
        super().__init__([sys.executable, "-m", "prefect", *start])
