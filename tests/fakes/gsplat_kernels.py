"""The functions of gsplat 1.5 that the rasterizer calls, slow and obvious, in torch on the CPU.

They follow gsplat's documentation and kernels: the centre of the first pixel is at 0.5; alpha is at most .999, and 0
below 1/255; a pixel ends before the splat that would leave no more than 1e-4 of the background; tiles list the splats
whose bounding boxes overlap them, nearest first. What isn't used (batches, several cameras, packed results) isn't here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

LEAST_ALPHA, MAX_ALPHA, LEAST_LEFT, WIDEST = 1 / 255, 0.999, 1e-4, 3.33


def fully_fused_projection(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    eps2d: float = 0.3, near_plane: float = 0.01, *, opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:  # fmt: skip
    """Radii (1, N, 2), centres (1, N, 2), depths (1, N) and inverse covariances (1, N, 3) in the image."""
    assert (
        covars is None and viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and opacities.shape == means.shape[:1]
    )
    R, t, (fx, fy), (cx, cy) = viewmats[0, :3, :3], viewmats[0, :3, 3], Ks[0].diagonal()[:2], Ks[0, :2, 2]
    x, y, z = (means @ R.T + t).unbind(dim=-1)
    side = 0.15 * width / fx, 0.15 * height / fy
    at_x = z * torch.clamp(x / z, float(-cx / fx - side[0]), float((width - cx) / fx + side[0]))
    at_y = z * torch.clamp(y / z, float(-cy / fy - side[1]), float((height - cy) / fy + side[1]))
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * at_x / z**2, zero, fy / z, -fy * at_y / z**2], dim=-1).reshape(-1, 2, 3)
    M = J @ R @ _rotations(quats) * scales[:, None, :]
    covariance = M @ M.transpose(1, 2) + eps2d * torch.eye(2)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    centre = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    conic = torch.stack([c, -b, a], dim=-1) / determinant[:, None]
    widest = torch.sqrt(2 * torch.log(opacities / LEAST_ALPHA)).clamp(max=WIDEST)
    radii = torch.ceil(widest[:, None] * torch.stack([a, c], dim=-1).sqrt())
    size = torch.tensor([width, height])
    inside = ((centre + radii > 0) & (centre - radii < size)).all(dim=-1)
    valid = (z >= near_plane) & (determinant > 0) & (opacities >= LEAST_ALPHA) & inside
    radii = torch.where(valid[:, None], radii, 0).int()
    return radii[None], centre[None], z[None], conic[None], None


def _rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations by quaternions w x y z of any length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(dim=-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


@torch.no_grad()
def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
) -> tuple[None, Tensor, Tensor]:
    """Keys (E,), which begin with the tile, and splats (E,) of the overlaps of splats and tiles, sorted by the keys."""
    low = torch.floor((means2d[0] - radii[0]) / tile_size).long()
    high = torch.ceil((means2d[0] + radii[0]) / tile_size).long()
    found = []
    for i in torch.nonzero((radii[0] > 0).all(dim=-1))[:, 0].tolist():
        (left, top), (right, bottom) = low[i].clamp(min=0).tolist(), high[i].tolist()
        found += [
            (y * tile_width + x, float(depths[0, i]), i)
            for y in range(top, min(bottom, tile_height))
            for x in range(left, min(right, tile_width))
        ]
    found.sort()
    keys = torch.tensor([tile << 32 for tile, _, _ in found], dtype=torch.int64)
    return None, keys, torch.tensor([i for _, _, i in found], dtype=torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """(1, rows, columns) first entry of each tile."""
    assert n_images == 1
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).int().reshape(1, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Colours (1, H, W, C), without a background, and alpha (1, H, W, 1)."""
    colour = torch.zeros(image_height * image_width, colors.shape[-1])
    alpha = torch.zeros(image_height * image_width)
    start = torch.ones(image_height * image_width)
    size = image_width, image_height, tile_size
    for pixel, splat, weight in _tiles(means2d, conics, opacities, start, *size, isect_offsets, flatten_ids):
        colour = colour.index_add(0, pixel, weight @ colors[0, splat])
        alpha = alpha.index_add(0, pixel, weight.sum(dim=1))
    return colour.reshape(1, image_height, image_width, -1), alpha.reshape(1, image_height, image_width, 1)


@torch.no_grad()
def rasterize_to_indices_in_range(
    range_start: int, range_end: int, transmittances: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor,
    image_width: int, image_height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Splats, pixels and images (E,) of the contributions, pixel by pixel, nearest first."""
    assert range_start == 0 and range_end >= len(flatten_ids) and transmittances.shape == (1, image_height, image_width)
    size = image_width, image_height, tile_size
    splats, pixels = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.int64)]
    for pixel, splat, weight in _tiles(
        means2d, conics, opacities, transmittances.flatten(), *size, isect_offsets, flatten_ids
    ):
        row, column = torch.nonzero(weight, as_tuple=True)
        splats.append(splat[column])
        pixels.append(pixel[row])
    splat, pixel = torch.cat(splats), torch.cat(pixels)
    order = torch.argsort(pixel, stable=True)  # gsplat writes them in the order of pixels, not of tiles
    return splat[order], pixel[order], torch.zeros_like(pixel)


def _tiles(
    centre: Tensor, conic: Tensor, opacity: Tensor, start: Tensor, width: int, height: int, side: int, offsets: Tensor,
    order: Tensor,
) -> Iterator[tuple[Tensor, Tensor, Any]]:  # fmt: skip
    """Pixels (P,), splats (K,) and weights (P, K) of the tiles; weights are 0 where a splat doesn't contribute.

    Args:
        centre, conic, opacity: of projected splats.
        start: (H * W,) transmittance before the first splat.
        width, height, side: of the image and of a tile, pixels.
        offsets, order: (1, rows, columns) first entry of each tile, and (E,) splats.
    """
    assert centre.dtype == torch.float32 and order.dtype == torch.int32
    ends = [*offsets.flatten().tolist()[1:], len(order)]
    for tile, (first, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        top, left = tile // offsets.shape[2] * side, tile % offsets.shape[2] * side
        v, u = torch.meshgrid(
            torch.arange(top, min(top + side, height)), torch.arange(left, min(left + side, width)), indexing="ij"
        )
        pixel, splat = (v * width + u).flatten(), order[first:end].long()
        dx = u.flatten()[:, None] + 0.5 - centre[0, splat, 0]
        dy = v.flatten()[:, None] + 0.5 - centre[0, splat, 1]
        a, b, c = conic[0, splat].unbind(dim=-1)
        alpha = (opacity[0, splat] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0)
        after = torch.cumprod(1 - alpha, dim=1) * start[pixel][:, None]
        alpha = torch.where(after > LEAST_LEFT, alpha, 0)
        before = torch.cat([start[pixel][:, None], after[:, :-1]], dim=1)[:, : len(splat)]
        yield pixel, splat, alpha * before
