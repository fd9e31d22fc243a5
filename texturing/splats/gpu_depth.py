"""Depth along the rays of pixels, from the splats that contribute to them: the formulas of `blending`, in torch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from scan2sim.pipeline.core.splats import LOG_SCALE, QUATERNION, XYZ
from scan2sim.texturing.splats.blending import HALF, HIGHEST, LOWEST, MAX_DEVIATION
from scan2sim.texturing.splats.projection import MIN_SLOPE_COS, Pinhole

MAX_ALPHA = 0.999
"""Of gsplat's kernels."""


class Contributions(NamedTuple):
    """Splats that contribute to pixels, those of a pixel in sequence, nearest first; arrays are (E,).

    Attributes:
        pixel: index of the pixel, row by row.
        before: transmittance before the splat.
        weight: share of the pixel's light that is the splat's.
        inverse: inverse depth of the splat at the pixel, 1/metres.
    """

    pixel: Tensor
    before: Tensor
    weight: Tensor
    inverse: Tensor


def contributions(
    pixel: Tensor, offset: Tensor, conic: Tensor, opacity: Tensor, depth: Tensor, slope: Tensor
) -> Contributions:
    """Contributions of splats to pixels, differentiable by all arguments but the slopes.

    Args:
        pixel: (E,) index of the pixel, those of a pixel in sequence, nearest splat first.
        offset: (E, 2) pixels from the splat's centre.
        conic: (E, 3) inverse covariance in the image.
        opacity: (E,) of the splat.
        depth: (E,) of the splat's centre, metres.
        slope: (E, 2) change of the splat's inverse depth per pixel.
    """
    x, y = offset.unbind(dim=-1)
    a, b, c = conic.unbind(dim=-1)
    alpha = (opacity * torch.exp(-(a * x * x + 2 * b * x * y + c * y * y) / 2)).clamp(max=MAX_ALPHA)
    before = _transmittance(pixel, alpha)
    centre = 1 / depth
    here = centre + (slope * offset).sum(dim=-1)
    inverse = torch.clamp(here, float(LOWEST) * centre.detach(), float(HIGHEST) * centre.detach())
    return Contributions(pixel, before, before * alpha, inverse)


def _transmittance(pixel: Tensor, alpha: Tensor) -> Tensor:
    """(E,) product of 1 - alpha of the earlier entries of the same pixel: a running sum over all pixels, in 64 bits."""
    logarithm = torch.log1p(-alpha.double())
    before = torch.cumsum(logarithm, dim=0) - logarithm
    first = torch.ones_like(pixel, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    entry = torch.arange(len(pixel), device=pixel.device)
    start = torch.cummax(torch.where(first, entry, 0), dim=0).values if len(pixel) else entry
    return torch.exp(before - before[start]).to(alpha.dtype)


def deviation(found: Contributions, known: Tensor) -> Tensor:
    """(H, W) relative deviation of inverse depths from known depths (H, W), limited for each splat, times alpha."""
    relative = found.inverse * known.flatten()[found.pixel] - 1
    limited = found.weight * relative.abs().clamp(max=float(MAX_DEVIATION))
    return torch.zeros_like(known).flatten().index_add(0, found.pixel, limited).reshape(known.shape)


def median(found: Contributions, shape: torch.Size) -> Tensor:
    """(H, W) depth at which half of the light is stopped, metres; inf where less is."""
    half = float(HALF)
    crossed = (found.before > half) & (found.before - found.weight <= half)
    depth = torch.full(shape, torch.inf, device=found.pixel.device).flatten()
    depth[found.pixel[crossed]] = 1 / found.inverse[crossed]
    return depth.reshape(shape)


def slopes(parameters: Tensor, splat: Tensor, camera: Pinhole) -> Tensor:
    """(E, 2) change of the inverse depth of splats per pixel: as `projection._slopes`.

    Args:
        parameters: (N, 14) of all splats.
        splat: (E,) indices.
        camera: the camera.
    """
    rotation, translation, intrinsics = (torch.tensor(one, device=parameters.device) for one in camera[:3])
    scale = parameters[:, LOG_SCALE]
    thinnest, middle, _ = scale.sort(dim=1).values.unbind(dim=-1)
    normal = _axis(parameters[:, QUATERNION], scale.argmin(dim=1)) @ rotation.T
    centre = parameters[:, XYZ] @ rotation.T + translation
    along = (normal * centre).sum(dim=-1)
    share = MIN_SLOPE_COS**2 * centre.square().sum(dim=-1)
    factor = (1 - torch.exp(4 * (thinnest - middle))) * along / (along * along + share)
    return (factor[:, None] * normal[:, :2] / intrinsics[:2])[splat]


def _axis(quaternion: Tensor, axis: Tensor) -> Tensor:
    """(N, 3) the axes with the indices `axis` (N,) of rotations (N, 4), w x y z of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(dim=-1)
    columns = torch.stack([
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ], dim=1)  # fmt: skip
    return columns[torch.arange(len(axis), device=axis.device), axis]
