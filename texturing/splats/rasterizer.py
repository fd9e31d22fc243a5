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
        depth: (H, W) along the optical axis in metres, times alpha; where a depth was known, the deviation from it,
            relative to it and at most `blending.MAX_DEVIATION`, times alpha.
        transmittance: (H, W) share of the background that is seen.
    """

    colour: F32
    depth: F32
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
        self, background: F32, by_colour: F32, by_depth: F32 | None = None, by_alpha: F32 | None = None
    ) -> F32:
        """Gradients (M, 14) of the parameters of the splats `seen`.

        Args:
            background: (H, W, 3) the background.
            by_colour: (H, W, 3) derivatives of the loss by `over(background)`.
            by_depth: (H, W) by `depth`; None: 0.
            by_alpha: (H, W) by 1 - `transmittance`, apart from the effect on the colour; None: 0.
        """
        nothing = np.zeros(by_colour.shape[:2], np.float32)
        more = [nothing if one is None else one for one in (by_depth, by_alpha)]
        gradient = tiles.to_tiles(np.concatenate([by_colour, np.stack(more, axis=-1)], axis=-1))
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
    blended = np.empty((len(found.start) - 1, 5, tiles.PIXELS), np.float32)
    last = np.zeros(len(blended), np.int32)
    if known is None:
        expected = np.zeros((len(blended), tiles.PIXELS), np.float32)
    else:
        expected = tiles.to_tiles(known[..., None])[:, 0]
    blending.blend(parameters, projected, found.columns, found.start, found.splat, expected, blended, last)
    image = tiles.from_tiles(blended, camera.width, camera.height)
    return Rendered(
        image[..., :3], image[..., 3], image[..., 4], parameters, camera, projected, found, expected, blended, last
    )  # fmt: skip
