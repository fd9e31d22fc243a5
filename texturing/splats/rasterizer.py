"""Rasterizer of splats on the CPU: forward and backward, with the same bytes at any number of threads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, I32
from scan2sim.texturing.splats import blending, projection, tiles
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.tiles import Assignment


@dataclass(frozen=True)
class Rendered:
    """Splats in an image.

    Attributes:
        colour: (H, W, 3) sRGB 0 to 1, times alpha: the background isn't added.
        depth: (H, W) metres along the optical axis to where half of the light is stopped (median), inf where more than
            half of it is the background's.
        deviation: (H, W) of the inverse depth from the known one, relative to it and at most `blending.MAX_DEVIATION`,
            times alpha; 0 where none is known.
        transmittance: (H, W) share of the background that is seen.
    """

    colour: F32
    depth: F32
    deviation: F32
    transmittance: F32
    _parameters: F32
    _camera: Pinhole
    _projected: F32
    _assignment: Assignment
    _known: F32
    _tiles: F32
    _last: I32

    @property
    def seen(self) -> I32:
        """(M,) indices of the splats that may be in the image."""
        return self._assignment.visible

    def over(self, background: F32) -> F32:
        """(H, W, 3) the colour over a background (H, W, 3)."""
        return self.colour + self.transmittance[..., None] * background

    def gradients(
        self, background: F32, by_colour: F32, by_deviation: F32 | None = None, by_alpha: F32 | None = None
    ) -> F32:
        """Gradients (M, 14) of the parameters of the splats `seen`.

        Args:
            background: (H, W, 3) the background.
            by_colour: (H, W, 3) derivatives of the loss by `over(background)`.
            by_deviation: (H, W) by `deviation`; None: 0.
            by_alpha: (H, W) by 1 - `transmittance`, apart from the effect on the colour; None: 0.
        """
        every = np.zeros((*by_colour.shape[:2], 5), np.float32)
        every[..., :3] = by_colour
        if by_deviation is not None:
            every[..., 3] = by_deviation
        if by_alpha is not None:
            every[..., 4] = by_alpha
        gradient = tiles.to_tiles(every)
        gradient[:, blending.DEVIATION][self._known == 0] = 0
        found = self._assignment
        entries = np.zeros((len(found.splat), projection.GRADIENT), np.float32)
        blending.blend_gradients(
            self._parameters, self._projected, found.columns, found.start, found.splat, found.slot,
            self._known, self._tiles, self._last, tiles.to_tiles(background), gradient, entries,
        )  # fmt: skip
        return projection.parameter_gradients(
            self._parameters, self._camera, self._projected, found.visible, found.first, entries
        )


def render(parameters: F32, camera: Pinhole, known: F32 | None = None) -> Rendered:
    """Render splats (N, 14) (`Splats.parameters`) into the image of a camera.

    Args:
        parameters: of the splats.
        camera: the camera.
        known: (H, W) depths along the optical axis that are known, metres, 0 where none is; None: none.
    """
    projected, visible = projection.project(parameters, camera)
    found = tiles.assign(projected, visible, camera.width, camera.height)
    blended = np.empty((len(found.start) - 1, blending.CHANNELS, blending.PIXELS), np.float32)
    last = np.zeros(len(blended), np.int32)
    if known is None:
        expected = np.zeros((len(blended), blending.PIXELS), np.float32)
    else:
        expected = tiles.to_tiles(known[..., None])[:, 0]
    blending.blend(
        parameters, projected, found.columns, found.start, found.splat, expected, camera.width, camera.height, blended,
        last,
    )  # fmt: skip
    image = tiles.from_tiles(blended, camera.width, camera.height)
    deviation = np.zeros(image.shape[:2], np.float32) if known is None else image[..., blending.DEVIATION] * (known > 0)
    with np.errstate(divide="ignore"):
        depth = np.float32(1) / image[..., blending.MEDIAN]
    return Rendered(
        image[..., :3], depth, deviation, image[..., blending.TRANSMITTANCE], parameters, camera, projected, found,
        expected, blended, last,
    )  # fmt: skip
