"""What starts and stops workers, a file each: processes that take events from a queue, workers of a Prefect pool."""

from __future__ import annotations

from typing import Protocol


class Actuator(Protocol):
    """Keeps so many workers running as it was told, whatever becomes of them."""

    def scale(self, count: int) -> None:
        """Start or stop workers until so many run; returns at once."""

    def workers(self) -> int:
        """Workers that run."""

    def close(self) -> None:
        """Stop all, and wait for their end."""
