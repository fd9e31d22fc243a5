"""Consumers of exports: one module per program, found by name and run by `bench.gate`.

Each module has `FORMAT`, the format that it reads; `missing()`, the reason why it can't run here, or an empty text; and
`check(export, reference)`, which returns metrics or raises `Fault` for the first error.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from bench.gate.places import WorldReference


class Fault(Exception):
    """A consumer rejects an export, or behaves wrongly with it.

    Args:
        text: description.
        metrics: metrics measured nevertheless.
    """

    def __init__(self, text: str, metrics: Mapping[str, Any] | None = None) -> None:
        super().__init__(text)
        self.metrics = dict(metrics or {})


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
