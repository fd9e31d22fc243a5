"""Consumers of exports: one module per program, found by name; used by tests and by `bench.gate`.

Each module has `FORMAT`, the format that it reads; `missing()`, the reason why it can't run here, or an empty text; and
`check(export, reference)`, which returns metrics or raises `Fault` for the first error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from tests.fakes.world_checks.reference import WorldReference


class Consumer(Protocol):
    """Interface of a consumer's module."""

    FORMAT: str

    def missing(self) -> str:
        """Reason why it can't run here, or an empty string."""

    def check(self, export: Path, reference: WorldReference) -> dict[str, Any]:
        """Check an exported world and return metrics.

        Args:
            export: folder of the world in the consumer's format.
            reference: reference data of the world: drop points, routes, photos.

        Raises:
            Fault: the check failed.
        """
