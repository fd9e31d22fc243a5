"""A node that starts and stops workers of a Prefect pool as the bus asks for them."""

from __future__ import annotations

from typing import Any

from scan2sim.pipeline.errors import SettingError
from scan2sim.services.monitoring.actuators.prefect import PrefectWorkers
from scan2sim.services.monitoring.bus import Bus
from scan2sim.services.monitoring.events import WorkersWanted
from scan2sim.services.monitoring.joined import PoolParams
from scan2sim.services.monitoring.monitor import ros


class PoolNode(ros.Node):  # type: ignore[misc]
    """Does what events `workers` of one queue say, within its own limits."""

    def __init__(self, params: PoolParams, node_name: str = "pool") -> None:
        """Start as many as there are to be at least.

        Raises:
            SettingError: the limits contradict each other.
            UnavailableError: Prefect isn't installed.
        """
        if params.min_workers > params.max_workers:
            limits = f"{params.min_workers} and {params.max_workers}"
            raise SettingError("--min-workers", f"must not be above --max-workers (got {limits})", "Change one of them")
        self._params = params
        self._workers = PrefectWorkers(params.pool)
        self._workers.scale(params.min_workers)
        super().__init__(node_name)
        self._bus = Bus(self, params)
        self._bus.events.on("workers", self._scale)

    def _scale(self, wanted: WorkersWanted) -> None:
        if wanted.queue == (self._params.queue or self._params.pool):
            self._workers.scale(max(self._params.min_workers, min(self._params.max_workers, wanted.workers)))

    def destroy_node(self) -> Any:
        """Stop all workers, and end."""
        self._bus.close()
        self._workers.close()
        return super().destroy_node()
