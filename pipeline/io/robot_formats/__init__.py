"""The robot (`pipeline.simulation.robot`) in formats of simulators: one file each, named as the world's format."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.simulation.robot import Robot, Start

PACKAGE = "scan2sim.pipeline.io.robot_formats"


class Format(Protocol):
    """Of robots."""

    def write(self, robot: Robot, start: Start, folder: Path) -> None:
        """Write a robot into `folder`, where the world is."""
