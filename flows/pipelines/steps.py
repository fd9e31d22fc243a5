"""All steps of all pipelines."""

from __future__ import annotations

from scan2sim.flows.pipelines import drive, images, tile, video
from scan2sim.pipeline.core.step import Step

STEPS: tuple[Step, ...] = (*tile.STEPS, *video.STEPS, *drive.STEPS, *images.STEPS)
