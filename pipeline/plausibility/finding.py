"""A finding about a tile, and how bad it is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What isn't plausible.

    Attributes:
        severity: 3: the world will be unusable; 2: large parts of it; 1: details.
        text: the fact with its figure, its likely cause, and what to do.
    """

    severity: int
    text: str
