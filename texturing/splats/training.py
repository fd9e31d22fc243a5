"""Training: splats and background descend the difference between their renderings and the photos, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.splats import (
    AXIS,
    GAIN,
    LOGIT,
    MAX_COLOUR,
    OFFSET,
    PHOTO_WIDTH,
    POSITION,
    RGB,
    VIGNETTING,
    Splats,
)
from scan2sim.pipeline.core.types import F32
from scan2sim.texturing.splats import loss, rasterizer
from scan2sim.texturing.splats.background import Background
from scan2sim.texturing.splats.descent import Descent, rates
from scan2sim.texturing.splats.exposure import Gains, Response
from scan2sim.texturing.splats.shots import SCALES, Level, Shot

BACKGROUND_RATE = 0.01
MIN_BACKGROUND = 0.02
"""Transmittance from which a pixel changes the background behind it."""
CONSTANT_SHARE = 0.3
"""Share of the epochs after which rates fall, to a tenth at the end."""
GAIN_RATE = 0.2
"""Share by which a photo's gain moves to the solution at every visit but the first."""
MIN_OPACITY = 0.02
"""Splats that end below it are removed."""


@dataclass(frozen=True)
class Schedule:
    """Visits and rates.

    Attributes:
        epochs: visits of every photo in a quarter, half and full size.
        position, scale, rotation, opacity, colour: first step of each parameter; positions in sizes of the splat.
        cover: weight of the loss that covers what isn't sky, and uncovers what is.
        depth: weight of the deviation from known inverse depths, relative to these.
        seed: of the order of the photos.
    """

    epochs: tuple[int, int, int] = (5, 12, 14)
    position: float = 0.05
    scale: float = 0.02
    rotation: float = 0.01
    opacity: float = 0.05
    colour: float = 0.015
    cover: float = 0.017
    depth: float = 0.3
    seed: int = 0


@dataclass
class Training:
    """State of a training, which can be saved and continued.

    Attributes:
        descent: the splats.
        background: what is behind them.
        gains: exposure of the photos, in the order of their first shots.
        epoch: number of finished epochs.
    """

    descent: Descent
    background: Background
    gains: Gains
    epoch: int = 0

    @classmethod
    def of(cls, splats: Splats, size: F32, background: Background, photos: int) -> Training:
        """A training that begins with these splats."""
        return cls(Descent(splats.parameters.copy(), size), background, Gains(photos))

    def run(self, shots: Sequence[Shot], schedule: Schedule, report: Callable[[float, str], None]) -> None:
        """Train to the end of the schedule, from the epoch where it is.

        Args:
            shots: photos of training.
            schedule: visits and rates.
            report: is called after every epoch with the share that is done and the mean PSNR.
        """
        photos = _numbers(shots)
        stages = [stage for stage, count in enumerate(schedule.epochs) for _ in range(count)]
        for epoch in range(self.epoch, len(stages)):
            done = epoch / len(stages)
            decay = 0.1 ** max(0.0, (done - CONSTANT_SHARE) / (1 - CONSTANT_SHARE))
            order = np.random.default_rng((schedule.seed, epoch)).permutation(len(shots))
            psnr = [
                self._visit(photos[shots[k].name], shots[k].levels[stages[epoch]], schedule, decay)
                for k in order.tolist()
            ]
            self._recolour(*self.gains.centre())
            self.epoch = epoch + 1
            known = [one for one in psnr if not math.isnan(one)] or [math.nan]
            report(self.epoch / len(stages), f"1/{SCALES[stages[epoch]]} size, {np.mean(known):.1f} dB")

    def _recolour(self, factor: F32, offset: F32) -> None:
        """Change all colours of the world."""
        self.descent.parameters[:, RGB] = np.clip(self.descent.parameters[:, RGB] * factor + offset, 0, MAX_COLOUR)
        self.background.recolour(factor, offset)

    def rendered(self, level: Level) -> tuple[rasterizer.Rendered, F32]:
        """The splats in a photo, and the background there."""
        drawn = rasterizer.render(self.descent.parameters, level.camera, level.known)
        return drawn, self.background.seen(level.texels)

    def _visit(self, k: int, level: Level, schedule: Schedule, decay: float) -> float:
        """Take a step towards a photo; returns the PSNR before it."""
        drawn, behind = self.rendered(level)
        image = drawn.over(behind)
        self.gains.solve(k, image, level.rgb, level.used, level.exposed, 1.0 if self.epoch == 0 else GAIN_RATE)
        found = loss.photometric(image, level.rgb, level.used, self.gains.response(k, level.exposed))
        used = level.used.astype(np.float32)
        cover = np.float32(schedule.cover) * used * np.where(level.sky, np.float32(1), np.float32(-1))
        by_parameters = drawn.gradients(behind, found.gradient, np.float32(schedule.depth) * used, cover)
        first = rates(schedule.position, schedule.scale, schedule.rotation, schedule.opacity, schedule.colour)
        self.descent.step(drawn.seen, by_parameters, first * np.float32(decay))
        through = np.where(drawn.transmittance > MIN_BACKGROUND, drawn.transmittance, np.float32(0))
        self.background.descend(level.texels, found.gradient * through[..., None], BACKGROUND_RATE * decay)
        return found.psnr

    def photos(self, shots: Sequence[Shot]) -> F32:
        """(P, 14) how the photos show the world (`SplatLayer.photos`)."""
        numbers = _numbers(shots)
        rows = np.zeros((len(numbers), PHOTO_WIDTH), np.float32)
        for shot in reversed(shots):  # of several of a photo, the first counts
            row, exposed = rows[numbers[shot.name]], Response.of(shot.exposure, shot.vignetting)
            response = self.gains.response(numbers[shot.name], exposed)
            row[POSITION], row[AXIS] = shot.T_world_cam[:3, 3], shot.T_world_cam[:3, 2]
            row[GAIN], row[OFFSET], row[VIGNETTING] = response.gain, response.offset, shot.exposure[3:]
        return rows

    def result(self) -> Splats:
        """The splats that are visible.

        Raises:
            StepError: the training has diverged.
        """
        parameters = self.descent.parameters
        broken = int((~np.isfinite(parameters).all(axis=1)).sum())
        if broken:
            raise StepError(
                "splats", f"the training diverged: {broken} splats aren't finite", "Report it with the tile"
            )
        return Splats(parameters[parameters[:, LOGIT] > math.log(MIN_OPACITY / (1 - MIN_OPACITY))])

    def save(self, path: Path) -> None:
        """Write the state, replacing the file at once."""
        temporary = path.with_suffix(".partial.npz")
        state: dict[str, Any] = {f"descent_{name}": value for name, value in self.descent.save().items()}
        state |= {"epoch": self.epoch, "gain": self.gains.gain, "offset": self.gains.offset}
        np.savez(temporary, **(state | self.background.save()))
        temporary.replace(path)

    @classmethod
    def load(cls, path: Path) -> Training:
        """Read what `save` wrote."""
        with np.load(path) as state:
            descent = {name.removeprefix("descent_"): state[name] for name in state if name.startswith("descent_")}
            gains = Gains(len(state["gain"]))
            gains.gain, gains.offset = state["gain"], state["offset"]
            return cls(Descent.load(descent), Background.load(dict(state)), gains, int(state["epoch"]))


def _numbers(shots: Sequence[Shot]) -> dict[str, int]:
    """Numbers of the photos, in the order of their first shots."""
    return {name: k for k, name in enumerate(dict.fromkeys(shot.name for shot in shots))}
