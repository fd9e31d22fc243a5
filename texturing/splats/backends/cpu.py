"""Splats on the CPU: numba kernels, with the same bytes at any number of threads."""

from __future__ import annotations

from dataclasses import dataclass

from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import F32
from scan2sim.texturing.splats import rasterizer
from scan2sim.texturing.splats.projection import Pinhole

RANK = 1


@dataclass(frozen=True)
class CpuScene:
    """Splats (N, 14)."""

    parameters: F32

    def render(self, camera: Pinhole, known: F32 | None = None) -> rasterizer.Rendered:
        """Render the image of a camera (`backends.Scene`)."""
        return rasterizer.render(self.parameters, camera, known)


def unavailable() -> Unavailable | None:
    """It runs on every machine."""
    return None


def description() -> str:
    """What renders, for the log."""
    return "on the CPU"


def scene(parameters: F32) -> CpuScene:
    """The splats (N, 14), which aren't copied."""
    return CpuScene(parameters)
