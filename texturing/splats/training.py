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
    CAMERA,
    GAIN,
    LOGIT,
    MAX_COLOUR,
    MIN_COLOUR,
    OFFSET,
    PHOTO_WIDTH,
    POSITION,
    RGB,
    VIGNETTING,
    Splats,
)
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.texturing.splats import loss
from scan2sim.texturing.splats.backends import Backend, Rendered, cpu
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
MIN_WEIGHT_PX, WEIGHED_SIZE = 0.05, 1
"""Pixels of all photos together, in the size with this index, that a splat must cover to be kept: what no photo shows,
as it is behind its camera or hidden, would be a haze in other views."""


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
        gains: exposure of the photos, which are numbered in the order of their first shots.
        epoch: number of finished epochs.
        backend: what renders, not a part of what is saved.
    """

    descent: Descent
    background: Background
    gains: Gains
    epoch: int = 0
    backend: Backend = cpu

    @classmethod
    def of(cls, splats: Splats, size: F32, background: Background, shots: Sequence[Shot]) -> Training:
        """A training on shots that begins with these splats."""
        names = list(dict.fromkeys(shot.name for shot in shots))
        photo_of = np.array([names.index(shot.name) for shot in shots], np.int32)
        return cls(Descent(splats.parameters.copy(), size), background, Gains(photo_of))

    def run(self, shots: Sequence[Shot], schedule: Schedule, report: Callable[[float, str], None]) -> None:
        """Train to the end of the schedule, from the epoch where it is.

        Args:
            shots: those that the training was made for.
            schedule: visits and rates.
            report: is called after every epoch with the share that is done and the mean PSNR.

        Raises:
            StepError: the training has diverged.
        """
        stages = [stage for stage, count in enumerate(schedule.epochs) for _ in range(count)]
        for epoch in range(self.epoch, len(stages)):
            done = epoch / len(stages)
            decay = 0.1 ** max(0.0, (done - CONSTANT_SHARE) / (1 - CONSTANT_SHARE))
            order = np.random.default_rng((schedule.seed, epoch)).permutation(len(shots))
            psnr = [self._visit(k, shots[k].levels[stages[epoch]], schedule, decay) for k in order.tolist()]
            self._recolour(*self.gains.centre())
            self._check()
            self.epoch = epoch + 1
            known = [one for one in psnr if not math.isnan(one)] or [math.nan]
            report(self.epoch / len(stages), f"1/{SCALES[stages[epoch]]} size, {np.mean(known):.1f} dB")

    def _recolour(self, factor: F32, offset: F32) -> None:
        """Change all colours of the world."""
        colours = self.descent.parameters[:, RGB]
        colours[:] = np.clip(colours * factor + offset, MIN_COLOUR, MAX_COLOUR)
        self.background.recolour(factor, offset)

    def rendered(self, level: Level) -> tuple[Rendered, F32]:
        """The splats in a photo, and the background there."""
        drawn = self.backend.scene(self.descent.parameters).render(level.camera, level.known)
        return drawn, self.background.seen(level.texels)

    def _visit(self, k: int, level: Level, schedule: Schedule, decay: float) -> float:
        """Take a step towards a shot; returns the PSNR before it."""
        drawn, behind = self.rendered(level)
        image = drawn.over(behind)
        self.gains.solve(k, image, level.rgb, level.used, level.exposed, 1.0 if self.epoch == 0 else GAIN_RATE)
        response = self.gains.response(self.gains.photo_of[k], level.exposed)
        found = loss.photometric(image, level.rgb, level.used, response)
        used = level.used.astype(np.float32)
        cover = np.float32(schedule.cover) * used * np.where(level.sky, np.float32(1), np.float32(-1))
        by_parameters = drawn.gradients(behind, found.gradient, np.float32(schedule.depth) * used, cover)
        first = rates(schedule.position, schedule.scale, schedule.rotation, schedule.opacity, schedule.colour)
        self.descent.step(drawn.seen, by_parameters, first * np.float32(decay))
        through = np.where(drawn.transmittance > MIN_BACKGROUND, drawn.transmittance, np.float32(0))
        self.background.descend(level.texels, found.gradient * through[..., None], BACKGROUND_RATE * decay)
        return found.psnr

    def photos(self, shots: Sequence[Shot]) -> tuple[F32, tuple[str, ...]]:
        """(P, 15) how the photos show the world, and the names of their cameras (`SplatLayer`)."""
        cameras = tuple(dict.fromkeys(shot.taken_by for shot in shots))
        rows = np.zeros((len(self.gains.gain), PHOTO_WIDTH), np.float32)
        for photo, shot in zip(self.gains.photo_of, shots, strict=True):  # several of a photo give the same row
            row, response = rows[photo], self.gains.response(photo, Response.of(shot.exposure, shot.vignetting))
            row[POSITION], row[AXIS], row[CAMERA] = shot.T_world_cam[:3, 3], shot.axis, cameras.index(shot.taken_by)
            row[GAIN], row[OFFSET], row[VIGNETTING] = response.gain, response.offset, shot.exposure[3:]
        return rows, cameras

    def result(self, shots: Sequence[Shot]) -> Splats:
        """The splats that the shots show."""
        parameters = self.descent.parameters
        opaque = parameters[:, LOGIT] > math.log(MIN_OPACITY / (1 - MIN_OPACITY))
        return Splats(parameters[opaque & (self._weights(shots) > MIN_WEIGHT_PX)])

    def _weights(self, shots: Sequence[Shot]) -> F64:
        """(N,) pixels that each splat covers in the shots, where these are compared, times its share of their light."""
        total = np.zeros(len(self.descent.parameters))
        for shot in shots:
            level = shot.levels[WEIGHED_SIZE]
            drawn, behind = self.rendered(level)
            red = np.zeros((*level.used.shape, 3), np.float32)
            red[..., 0] = level.used
            # the image is the sum of the splats' colours times their weights: by a colour, its derivative is the weight
            total[drawn.seen] += drawn.gradients(behind, red)[:, RGB][:, 0]
        return total

    def _check(self) -> None:
        """Check that all parameters are finite.

        Raises:
            StepError: some aren't: the training has diverged.
        """
        parts = {
            "splats": self.descent.parameters,
            "gains of photos": self.gains.gain,
            "offsets of photos": self.gains.offset,
            "texels of the background": self.background.texture.reshape(-1, 3),
        }
        broken = {name: int((~np.isfinite(rows).all(axis=1)).sum()) for name, rows in parts.items()}
        if any(broken.values()):
            counts = ", ".join(f"{count:,} {name}" for name, count in broken.items() if count)
            raise StepError("splats", f"the training diverged: {counts} aren't finite", "Report it with the tile")

    def save(self, path: Path) -> None:
        """Write the state, replacing the file at once.

        Raises:
            StepError: the training has diverged; the file stays as it is.
        """
        self._check()
        temporary = path.with_suffix(".partial.npz")
        state: dict[str, Any] = {f"descent_{name}": value for name, value in self.descent.save().items()}
        state |= {f"gains_{name}": value for name, value in self.gains.save().items()}
        np.savez(temporary, epoch=self.epoch, **(state | self.background.save()))
        temporary.replace(path)

    @classmethod
    def load(cls, path: Path) -> Training:
        """Read what `save` wrote."""
        with np.load(path) as state:
            descent, gains = (
                {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}
                for prefix in ("descent_", "gains_")
            )
            return cls(Descent.load(descent), Background.load(dict(state)), Gains.load(gains), int(state["epoch"]))
