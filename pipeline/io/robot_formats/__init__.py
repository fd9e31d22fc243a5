"""Writers of the robot (`pipeline.simulation.robot`) for simulators: one module each, named like the world format."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.simulation.robot import Robot, Start

PACKAGE = "scan2sim.pipeline.io.robot_formats"


class Format(Protocol):
    """Interface of a format's module."""

    def write(self, robot: Robot, start: Start, folder: Path) -> None:
        """Write a robot into `folder`, which contains the world."""
