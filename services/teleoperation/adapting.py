"""How a camera's video follows what the links carry."""

from __future__ import annotations

from typing import NamedTuple


class Plan(NamedTuple):
    """How a camera's pictures are sent.

    Attributes:
        bitrate: bits a second.
        fps: pictures a second, at most.
        scale: of the picture's sides, at most 1.
    """

    bitrate: int = 1_500_000
    fps: float = 30.0
    scale: float = 1.0
