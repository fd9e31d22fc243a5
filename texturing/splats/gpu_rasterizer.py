"""Rasterizer of splats by gsplat's kernels: forward by these, backward by torch's autograd.

gsplat blends colours and alpha. Depth isn't a blended channel, as each splat's deviation from a known depth is limited,
and as a pixel's depth is a median: it is computed from the splats that contribute to each pixel (`gpu_depth`), of which
gsplat returns the indices.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scan2sim.pipeline.core.splats import LOG_SCALE, LOGIT, QUATERNION, RGB, XYZ
from scan2sim.pipeline.core.types import F32, I32
from scan2sim.texturing.splats import gpu_depth
from scan2sim.texturing.splats.gpu_depth import Contributions
from scan2sim.texturing.splats.projection import LOW_PASS, NEAR_M, Pinhole

TILE_PX = 16
HALF_PIXEL = 0.5
"""Centre of the first pixel in gsplat; here it is at 0."""
EVERY_BATCH = 2**31 - 1


class GpuScene:
    """Splats on a device.

    Args:
        parameters: (N, 14) of the splats, copied.
        device: torch device.
        kernels: the package `gsplat`, or a module with the same functions.
    """

    def __init__(self, parameters: F32, device: str, kernels: Any) -> None:
        self._parameters, self._kernels = torch.tensor(parameters, device=device), kernels

    def render(self, camera: Pinhole, known: F32 | None = None) -> GpuRendered:
        """Render the image of a camera (`backends.Scene`)."""
        return GpuRendered(self._parameters.detach().requires_grad_(), camera, known, self._kernels)


class GpuRendered:
    """Splats in an image (`backends.Rendered`).

    Args:
        parameters: (N, 14) of the splats, a leaf of the graph.
        camera: the camera.
        known: (H, W) depths that are known, or 0; None: none.
        kernels: as of `GpuScene`.
    """

    def __init__(self, parameters: Tensor, camera: Pinhole, known: F32 | None, kernels: Any) -> None:
        self._parameters, self._camera, self._kernels = parameters, camera, kernels
        size = camera.width, camera.height
        self._opacity = torch.sigmoid(parameters[:, LOGIT])[None]
        self._radii, self._centre, self._depth, self._conic, _ = kernels.fully_fused_projection(
            parameters[:, XYZ], None, parameters[:, QUATERNION], parameters[:, LOG_SCALE].exp(), *self._matrices(),
            *size, eps2d=LOW_PASS, near_plane=NEAR_M, opacities=self._opacity[0].detach(),
        )  # fmt: skip
        columns, rows = (-(-side // TILE_PX) for side in size)
        _, keys, order = kernels.isect_tiles(
            self._centre.detach(), self._radii, self._depth.detach(), TILE_PX, columns, rows
        )
        self._tiles = *size, TILE_PX, kernels.isect_offset_encode(keys, 1, columns, rows), order
        colour, alpha = kernels.rasterize_to_pixels(
            self._centre, self._conic, parameters[None, :, RGB], self._opacity, *self._tiles
        )
        self._colour, self._alpha = colour[0], alpha[0, ..., 0]
        self._known = None if known is None else self._to(known)
        self._deviation = None if self._known is None else self._deviations(self._known)

    def _matrices(self) -> tuple[Tensor, Tensor]:
        """World to camera (1, 4, 4), and intrinsics (1, 3, 3)."""
        pose, (fx, fy, cx, cy) = np.eye(4, dtype=np.float32), self._camera.intrinsics.tolist()
        pose[:3, :3], pose[:3, 3] = self._camera.rotation, self._camera.translation
        intrinsics = [[fx, 0, cx + HALF_PIXEL], [0, fy, cy + HALF_PIXEL], [0, 0, 1]]
        return self._to(pose)[None], self._to(np.array(intrinsics, np.float32))[None]

    def _to(self, array: F32) -> Tensor:
        """An array on the device."""
        return torch.tensor(array, device=self._parameters.device)

    def _contributions(self, where: Tensor) -> Contributions:
        """What splats contribute to the pixels (H, W) that are true."""
        seen = (one.detach() for one in (self._centre, self._conic, self._opacity))
        splat, pixel, _ = self._kernels.rasterize_to_indices_in_range(
            0, EVERY_BATCH, where.to(torch.float32)[None], *seen, *self._tiles
        )
        x, y = pixel % self._camera.width + HALF_PIXEL, pixel // self._camera.width + HALF_PIXEL
        offset = torch.stack([x, y], dim=-1) - self._centre[0, splat]
        slope = gpu_depth.slopes(self._parameters.detach(), splat, self._camera)
        return gpu_depth.contributions(
            pixel, offset, self._conic[0, splat], self._opacity[0, splat], self._depth[0, splat], slope
        )

    def _deviations(self, known: Tensor) -> Tensor:
        """(H, W) deviations from known depths."""
        return gpu_depth.deviation(self._contributions(known > 0), known)

    @property
    def colour(self) -> F32:
        """(H, W, 3) sRGB 0 to 1, times alpha."""
        return self._image(self._colour)

    @property
    def transmittance(self) -> F32:
        """(H, W) share of the background that is seen."""
        return self._image(1 - self._alpha)

    @property
    def deviation(self) -> F32:
        """(H, W) limited relative deviation of the inverse depth from the known one, times alpha."""
        return self._image(torch.zeros_like(self._alpha) if self._deviation is None else self._deviation)

    @cached_property
    def depth(self) -> F32:
        """(H, W) median depth, metres along the optical axis, or inf."""
        with torch.no_grad():
            every = torch.ones_like(self._alpha, dtype=torch.bool)
            return self._image(gpu_depth.median(self._contributions(every), every.shape))

    @cached_property
    def seen(self) -> I32:
        """(M,) indices of the splats that may be in the image."""
        return np.asarray(self._seen.cpu().numpy(), np.int32)

    @property
    def _seen(self) -> Tensor:
        return torch.nonzero((self._radii[0] > 0).all(dim=-1))[:, 0]

    def over(self, background: F32) -> F32:
        """(H, W, 3) the colour over a background (H, W, 3)."""
        return self.colour + self.transmittance[..., None] * background

    def gradients(
        self, background: F32, by_colour: F32, by_deviation: F32 | None = None, by_alpha: F32 | None = None
    ) -> F32:
        """Gradients (M, 14) of the parameters of the splats `seen` (`backends.Rendered`)."""
        of_alpha = -(by_colour * background).sum(axis=-1) + (0 if by_alpha is None else by_alpha)
        images, derivatives = [self._colour, self._alpha], [self._to(by_colour), self._to(of_alpha.astype(np.float32))]
        if self._deviation is not None and by_deviation is not None:
            images.append(self._deviation)
            derivatives.append(self._to(by_deviation))
        (gradient,) = torch.autograd.grad(images, self._parameters, derivatives, retain_graph=True)
        return self._image(gradient[self._seen])

    @staticmethod
    def _image(tensor: Tensor) -> F32:
        """A tensor as an array on the CPU."""
        return np.asarray(tensor.detach().cpu().numpy(), np.float32)
