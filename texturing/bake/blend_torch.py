"""GPU version of `blend_numba.RowBlender` in torch: the same sums, for all texels of a photo at once.

Mirrors `blend_numba.accumulate` line by line; a test checks that both agree within one grey level. Import late: loads
torch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from scan2sim.pipeline.camera.models import EQUIRECTANGULAR, FISHEYE, OPENCV, ORTHO_EQUIVALENT_FOCAL_PX, ORTHOGRAPHIC
from scan2sim.pipeline.camera.projection import MAX_SLOPE, SLOPE_BIAS_FACTOR
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, F64, I64, U8
from scan2sim.texturing.bake.blend_numba import (
    OVEREXPOSED_LEVEL,
    UNRELIABLE_WEIGHT,
    BlendSettings,
    BlendSource,
    PageFaces,
)
from scan2sim.texturing.exposure_model import TONE_KNEE_LEVEL, overexposed_weight
from scan2sim.texturing.photo_cache import SRGB_OFFSET

CHUNK_TEXELS = 2_000_000
"""Texels processed at a time: about 500 MB."""


class TorchRowBlender:
    """`blend_numba.RowBlender` on a torch device.

    Args:
        page_faces: faces on the rows.
        device: torch device such as "cuda" or "cpu".

    Raises:
        SettingError: torch can't use the device.
    """

    def __init__(self, page_faces: PageFaces, device: str) -> None:
        try:
            self._device = torch.zeros(1, device=device).device
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise SettingError(
                "texture.device", f"torch can't use {device!r} ({reason})", 'Set "numba" or "auto"'
            ) from None
        owner = page_faces.owner
        self._shape = owner.shape
        owned = np.flatnonzero(owner.ravel() >= 0)
        self._texel = self._to(owned)
        self._face = self._to(owner.ravel()[owned].astype(np.int64))
        self._flat, self._normal = self._to(page_faces.flat).double(), self._to(page_faces.normals).double()
        corners = self._to(page_faces.corners).double()
        self._origin, self._per_x, self._per_y, self._is_valid = _frames(self._flat, corners)
        self._low, self._detail = (torch.zeros((owner.size, 4), device=self._device) for _ in range(2))

    def add(self, faces: I64, share: F32, source: BlendSource, settings: BlendSettings) -> int:
        """See `blend_numba.RowBlender`."""
        which = torch.full((len(self._flat),), -1, dtype=torch.int64, device=self._device)
        which[self._to(faces)] = torch.arange(len(faces), device=self._device)
        which[~self._is_valid] = -1
        texels = torch.nonzero(which[self._face] >= 0).ravel()
        shares, photo = self._to(share).double(), PhotoSampler(source, self._to)
        seen = [self._add(part, which, shares, photo, source, settings) for part in torch.split(texels, CHUNK_TEXELS)]
        return sum(seen)

    def resolve(self, rgb: U8, seen: U8, white: float) -> None:
        """See `blend_numba.RowBlender`."""
        low, detail = self._low, self._detail
        value = low[:, :3] / low[:, 3:] + torch.where(detail[:, 3:] > 0, detail[:, :3] / detail[:, 3:], 0.0)
        above = (value - TONE_KNEE_LEVEL).clamp(min=0)
        slope = 1 / (255 - TONE_KNEE_LEVEL) - 1 / (white - TONE_KNEE_LEVEL)
        value = torch.where(above > 0, TONE_KNEE_LEVEL + above / (1 + above * slope), value)
        has_colour = (low[:, 3] > 0).reshape(self._shape).cpu().numpy()
        colour = (value + 0.5).nan_to_num().clamp(0, 255).to(torch.uint8).reshape(*self._shape, 3).cpu().numpy()
        rgb[has_colour], seen[has_colour] = colour[has_colour], 255

    def _to(self, array: npt.NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)

    def _add(
        self,
        part: Tensor,
        which: Tensor,
        share: Tensor,
        photo: PhotoSampler,
        source: BlendSource,
        settings: BlendSettings,
    ) -> int:
        """Add a photo to some texels and return how many it sees; `which` (F,): row of each face in `share`, or -1."""
        camera, p, g = source.camera, source.camera.p, settings
        wide = camera.model == EQUIRECTANGULAR
        T = self._to(camera.T)
        R, t = T[:3, :3], T[:3, 3]
        texel, f = self._texel[part], self._face[part]
        tx, ty = (texel % self._shape[1]).double()[:, None], (texel // self._shape[1]).double()[:, None]
        per_x, per_y = self._per_x @ R.T, self._per_y @ R.T
        at = (self._origin @ R.T + t)[f] + tx * per_x[f] + ty * per_y[f]
        normal = (self._normal @ R.T)[f]
        focal = p[12] / (2 * math.pi) if wide else min(p[0], p[1])
        if camera.model == ORTHOGRAPHIC:  # the ground sample distance doesn't depend on the distance
            distance, cos, far = at[:, 2], -normal[:, 2], torch.ones_like(at[:, 2])
            equivalent_distance = far * (ORTHO_EQUIVALENT_FOCAL_PX / focal)
        else:
            distance = equivalent_distance = far = at.norm(dim=1)
            cos = -(at * normal).sum(dim=1) / distance
        u, v, ok = _project(camera.model, p, at)
        ok &= (v >= -0.5) & (v < p[13] - 0.5) & (cos >= 0.5 * g.min_cos)
        if not wide:
            ok &= (u >= -0.5) & (u < p[12] - 0.5)
        u, v = torch.where(ok, u, 0.0), torch.where(ok, v, 0.0)
        ok &= photo.allows(u, v)
        rows, columns = source.occlusion.first.shape
        column = ((u + 0.5) * (columns / p[12])).long().clamp(0, columns - 1)
        row = ((v + 0.5) * (rows / p[13])).long().clamp(0, rows - 1)
        lean = _slope(cos) * far * source.occlusion.pixel
        ok &= distance <= photo.first[row, column] + g.bias + SLOPE_BIAS_FACTOR * lean
        keep = torch.nonzero(ok).ravel()
        texel, f, tx, ty, u, v = (a[keep] for a in (texel, f, tx, ty, u, v))
        row, column, lean, distance, cos, far, equivalent_distance = (
            a[keep] for a in (row, column, lean, distance, cos, far, equivalent_distance)
        )

        border = torch.minimum(v + 0.5, p[13] - 0.5 - v)
        if not wide:
            border = torch.minimum(border, torch.minimum(u + 0.5, p[12] - 0.5 - u))
        base_weight = (cos * cos / equivalent_distance**2) ** g.power * (
            0.02 + 0.98 * (border / g.feather).clamp(max=1.0)
        )
        occluded = distance > photo.around[row, column] + g.bias + (source.occlusion.radius + 0.5) * lean
        weight = torch.where(occluded, base_weight * UNRELIABLE_WEIGHT, base_weight)
        factor = torch.exp(self._to(source.photo.exposure[:3])) * photo.vignette(u, v)[:, None]
        if source.photo.warp.shape[0]:
            u, v = photo.warped(u, v)
        size = torch.maximum((per_x**2).sum(dim=1), (per_y**2).sum(dim=1)).sqrt()[f]
        chosen = (share.sum(dim=1) > 0)[which[f]]
        colour = photo.colour(u, v, size * focal / far, chosen if g.band >= 0 else torch.ones_like(chosen))
        overexposed = colour.amax(dim=1) > OVEREXPOSED_LEVEL
        overexposed_factor = overexposed_weight(source.photo.exposure)
        base_weight = torch.where(overexposed, base_weight * overexposed_factor, base_weight)
        weight = torch.where(overexposed, weight * overexposed_factor, weight)
        coarse = colour if g.band < 0 else photo.coarse(u, v) if g.band > 0 else torch.zeros_like(colour)
        detail = 1e-4 * base_weight + torch.where(chosen, self._share(share[which[f]], f, tx[:, 0], ty[:, 0]), 0.0)
        hidden = distance > photo.near[row, column] + g.bias + 1.5 * lean
        detail = torch.where(hidden, detail * UNRELIABLE_WEIGHT, detail)
        base = (coarse + SRGB_OFFSET) * factor - SRGB_OFFSET if g.band != 0 else torch.zeros_like(colour)
        fine = (colour + SRGB_OFFSET) * factor - SRGB_OFFSET - base
        self._low[texel] += torch.cat([weight[:, None] * base, weight[:, None]], dim=1).float()
        self._detail[texel] += torch.cat([detail[:, None] * fine, detail[:, None]], dim=1).float()
        return len(keep)

    def _share(self, share: Tensor, f: Tensor, tx: Tensor, ty: Tensor) -> Tensor:
        """(M,) share at texels of faces `f`, interpolated from the corners' shares (M, 3)."""
        a, b, c = self._flat[f].unbind(dim=1)
        (bx, by), (cx, cy) = (b - a).unbind(dim=1), (c - a).unbind(dim=1)
        x, y = tx - a[:, 0], ty - a[:, 1]
        det = bx * cy - by * cx
        s, q = (x * cy - y * cx) / det, (bx * y - by * x) / det
        return (share[:, 0] * (1 - s - q) + share[:, 1] * s + share[:, 2] * q).clamp(min=0.0)


class PhotoSampler:
    """A photo on the device, sampled at pixels (u, v)."""

    def __init__(self, source: BlendSource, to: Any) -> None:
        photo, occlusion = source.photo, source.occlusion
        self._p, self._wide, self._exposure = source.camera.p, source.camera.model == EQUIRECTANGULAR, photo.exposure
        self._levels = [to(level) for level in (photo.full, photo.half, photo.quarter)]
        self._low, self._mask, self._warp = to(photo.low), to(photo.mask), to(photo.warp)
        self.first, self.near, self.around = to(occlusion.first), to(occlusion.near), to(occlusion.around)

    def allows(self, u: Tensor, v: Tensor) -> Tensor:
        """As `image_sampling.allows`."""
        rows, columns = self._mask.shape
        if not rows:
            return torch.ones_like(u, dtype=torch.bool)
        column = ((u + 0.5) * (columns / self._p[12])).long().clamp(0, columns - 1)
        row = ((v + 0.5) * (rows / self._p[13])).long().clamp(0, rows - 1)
        return self._mask[row, column] != 0

    def vignette(self, u: Tensor, v: Tensor) -> Tensor:
        """As `exposure_model.vignette`."""
        cx, cy = 0.5 * (self._p[12] - 1), 0.5 * (self._p[13] - 1)
        q = ((u - cx) ** 2 + (v - cy) ** 2) / (cx * cx + cy * cy)
        return torch.exp(self._exposure[3] * q + self._exposure[4] * q * q)

    def warped(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """As `blend_numba._warped`."""
        by = self._linear(self._warp, *self._rescaled(u, v, self._warp))
        return u + by[:, 0], v + by[:, 1]

    def coarse(self, u: Tensor, v: Tensor) -> Tensor:
        """(M, 3) low frequencies."""
        return self._linear(self._low, *self._rescaled(u, v, self._low))

    def colour(self, u: Tensor, v: Tensor, ratio: Tensor, sharp: Tensor) -> Tensor:
        """As `blend_numba._colour`: (M, 3) colours for texels that are `ratio` pixels wide."""
        level = (ratio >= 1.6).long() + (ratio >= 3.2).long()
        out = torch.empty((len(u), 3), dtype=torch.float64, device=u.device)
        bicubic = (level == 0) & sharp
        out[bicubic] = self._cubic(u[bicubic], v[bicubic])
        for k, image in enumerate(self._levels):
            at = (level == k) & ~bicubic
            out[at] = self._linear(image, *self._rescaled(u[at], v[at], image))
        return out

    def _rescaled(self, u: Tensor, v: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """As `image_sampling.rescaled`."""
        height, width = image.shape[:2]
        return (u + 0.5) * (width / self._p[12]) - 0.5, (v + 0.5) * (height / self._p[13]) - 0.5

    def _columns(self, x: Tensor, width: int) -> Tensor:
        return x % width if self._wide else x.clamp(0, width - 1)

    def _linear(self, image: Tensor, u: Tensor, v: Tensor) -> Tensor:
        height, width = image.shape[:2]
        u0, v0 = u.floor(), v.floor()
        fu, fv = (u - u0)[:, None], (v - v0)[:, None]
        a, b = self._columns(u0.long(), width), self._columns(u0.long() + 1, width)
        c, d = v0.long().clamp(0, height - 1), (v0.long() + 1).clamp(0, height - 1)
        top = image[c, a] * ((1 - fu) * (1 - fv)) + image[c, b] * (fu * (1 - fv))
        return top + image[d, a] * ((1 - fu) * fv) + image[d, b] * (fu * fv)

    def _cubic(self, u: Tensor, v: Tensor) -> Tensor:
        image = self._levels[0]
        height, width = image.shape[:2]
        u0, v0 = u.floor(), v.floor()
        wu, wv = _catmull_rom(u - u0), _catmull_rom(v - v0)
        out = torch.zeros((len(u), 3), dtype=torch.float64, device=u.device)
        for j in range(4):
            y = (v0.long() + j - 1).clamp(0, height - 1)
            for i in range(4):
                x = self._columns(u0.long() + i - 1, width)
                out += image[y, x] * (wu[i] * wv[j])[:, None]
        return out


def _catmull_rom(f: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    f2, f3 = f * f, f * f * f
    return (
        -0.5 * f3 + f2 - 0.5 * f,
        1.5 * f3 - 2.5 * f2 + 1,
        -1.5 * f3 + 2 * f2 + 0.5 * f,
        0.5 * f3 - 0.5 * f2,
    )


def _frames(flat: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As `texel_map.frame`, for all faces: (F, 3) origin, step per x, step per y, and (F,) whether they are valid."""
    a = flat[:, 0]
    (bx, by), (cx, cy) = ((flat[:, k] - a)[:, :, None].unbind(dim=1) for k in (1, 2))
    det = bx * cy - by * cx
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    per_x, per_y = (e1 * cy - e2 * by) / det, (e2 * bx - e1 * cx) / det
    return corners[:, 0] - a[:, :1] * per_x - a[:, 1:] * per_y, per_x, per_y, det[:, 0].abs() >= 1e-9


def _slope(cos: Tensor) -> Tensor:
    """Slope as in `projection.range_pixel`."""
    c = cos.clamp(max=1.0)
    return ((1 - c * c).sqrt() / c.clamp(min=1e-6)).clamp(max=MAX_SLOPE)


def _project(model: int, p: F64, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `models.project_point`, for (M, 3) points in camera axes: u, v and whether they are valid."""
    x, y, z = at.unbind(dim=1)
    if model == EQUIRECTANGULAR:
        r = at.norm(dim=1)
        u = (torch.atan2(x, z) / (2 * math.pi) + 0.5) * p[12] - 0.5
        return u, (torch.asin((y / r).clamp(-1, 1)) / math.pi + 0.5) * p[13] - 0.5, r >= 1e-9
    if model == FISHEYE:
        rxy = torch.hypot(x, y)
        theta = torch.atan2(rxy, z)
        t2 = theta * theta
        radius = theta * (1 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7]))))
        scale = torch.where(rxy > 1e-9, radius / rxy, 1.0 / z)
        return p[0] * x * scale + p[2], p[1] * y * scale + p[3], (theta < p[14]) & (rxy + z.abs() >= 1e-9)
    ok = z >= 1e-6
    if model == ORTHOGRAPHIC:
        return p[0] * x + p[2], p[1] * y + p[3], ok
    x, y = x / z, y / z
    if model == OPENCV:
        r2 = x * x + y * y
        ok = ok & (r2 < p[14] * p[14])
        radial = (1 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))) / (1 + r2 * (p[9] + r2 * (p[10] + r2 * p[11])))
        x, y = (
            x * radial + 2 * p[6] * x * y + p[7] * (r2 + 2 * x * x),
            y * radial + p[6] * (r2 + 2 * y * y) + 2 * p[7] * x * y,
        )
    return p[0] * x + p[2], p[1] * y + p[3], ok
