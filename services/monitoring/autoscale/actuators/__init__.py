"""Actuators of the autoscaler: start and stop Prefect workers or replicas in OSM; `work.local_workers` is another."""

from __future__ import annotations

from typing import Protocol


class Actuator(Protocol):
    """Keeps the requested number of workers running and restarts those that die."""

    def scale(self, count: int) -> None:
        """Set the number of workers; returns at once."""

    def workers(self) -> int:
        """Number of running workers."""

    def close(self) -> None:
        """Stop all workers and wait until they have ended."""
