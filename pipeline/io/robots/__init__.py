"""A robot (`pipeline.robot`) as simulators take it: a file a format, by the name of the format that its world is in."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.robot import Robot, Start

PACKAGE = "scan2sim.pipeline.io.robots"


class Format(Protocol):
    """Of robots."""

    def write(self, robot: Robot, start: Start, folder: Path) -> None:
        """Write a robot into `folder`, where the world is."""
