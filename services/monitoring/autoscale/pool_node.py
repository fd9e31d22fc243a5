"""Node that keeps as many workers running as the autoscaler requests on the bus."""

from __future__ import annotations

from typing import Any

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.autoscale.actuators import Actuator
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import WorkersWanted
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.settings.bus import WorkerPoolParams


class PoolNode(ros.Node):  # type: ignore[misc]
    """Applies the `workers` events of one queue, within its own limits."""

    def __init__(self, params: WorkerPoolParams, queue: str, workers: Actuator, node_name: str = "pool") -> None:
        """Start the minimum number of workers.

        Args:
            queue: name of the queue whose events are applied.
            workers: starts and stops the workers; closed with the node.

        Raises:
            SettingError: the limits contradict each other.
        """
        if params.min_workers > params.max_workers:
            limits = f"{params.min_workers} and {params.max_workers}"
            raise SettingError("--min-workers", f"must not be above --max-workers (got {limits})", "Change one of them")
        self._params, self._queue, self._workers = params, queue, workers
        self._workers.scale(params.min_workers)
        super().__init__(node_name)
        self._bus = Bus(self, params)
        self._bus.events.on("workers", self._scale)
        self._bus.start()

    def _scale(self, wanted: WorkersWanted) -> None:
        if wanted.queue == self._queue:
            self._workers.scale(max(self._params.min_workers, min(self._params.max_workers, wanted.workers)))

    def destroy_node(self) -> Any:
        """Stop all workers and destroy the node."""
        self._bus.close()
        self._workers.close()
        return super().destroy_node()
