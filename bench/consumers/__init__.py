"""What takes exports in: a file a consumer, found by name, run by `bench.gate`.

Each module has `FORMAT`, the format that it reads; `missing()`, why it can't run here, or an empty text; and
`check(export, places)`, which gives figures, or raises `Fault` with the first thing that it finds wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from bench.gate.places import Places


class Fault(Exception):
    """A consumer refuses an export, or what happens in it is wrong.

    Args:
        text: what.
        figures: that were measured all the same.
    """

    def __init__(self, text: str, figures: Mapping[str, Any] | None = None) -> None:
        super().__init__(text)
        self.figures = dict(figures or {})


class Consumer(Protocol):
    """What a consumer's module has."""

    FORMAT: str

    def missing(self) -> str:
        """Why it can't run here, or an empty text."""

    def check(self, export: Path, places: Places) -> dict[str, Any]:
        """Figures of an exported world.

        Args:
            export: folder of the world in the consumer's format.
            places: what is known of the same world: where to drop things, ways to drive, photos.

        Raises:
            Fault: something is wrong.
        """
