"""All steps of all recipes."""

from __future__ import annotations

from scan2sim.flows.recipes import drive, study, tile, video
from scan2sim.pipeline.step import Step

STEPS: tuple[Step, ...] = (*tile.STEPS, *video.STEPS, *drive.STEPS, *study.STEPS)
