"""Workers of a Prefect work pool, which make tiles and surveys (docs/deploy.md): as many as the bus asks for."""

from __future__ import annotations

import sys

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.monitoring.autoscale.actuators.replicas import Programs


class PrefectWorkers(Programs):
    """Processes `prefect worker start`, each of one run at a time; the server is PREFECT_API_URL's."""

    def __init__(self, pool: str) -> None:
        """Of a pool, which must be there.

        Raises:
            UnavailableError: Prefect isn't installed.
        """
        optional_deps.need("workers of a Prefect pool", "prefect")
        start = ["worker", "start", "--pool", pool, "--limit", "1", "--no-create-pool-if-not-found"]
        super().__init__([sys.executable, "-m", "prefect", *start])
