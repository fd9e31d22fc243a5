"""ALIKED (Zhao et al. 2023) with the user's aliked-t16.pth, -n16.pth, -n16rot.pth or -n32.pth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.slam import weights as files
from scan2sim.slam.features import FeatureSet, enlarged, reduced, unmasked

SCORE_MIN, SUPPRESSION_RADIUS_PX, SOFTMAX_TEMPERATURE = 0.2, 2, 0.1
"""Least score, radius of non-maximum suppression, and temperature of the soft-argmax refinement, as published."""
SIZE_MULTIPLE_PX = 32
"""Images are padded to a multiple of this."""
NEEDS = files.NEEDS
HINT = "Give one of ALIKED's aliked-t16.pth, aliked-n16.pth, aliked-n16rot.pth, aliked-n32.pth"


def _shapes(channels: tuple[int, int, int, int], positions: int) -> dict[str, files.Shape]:
    """Shapes of the tensors of a network of four blocks, whose descriptors are sampled at `positions` positions."""
    dim = channels[3]
    out: dict[str, files.Shape] = {}
    for block, (inner, outer) in enumerate(zip((3, *channels[:3]), channels, strict=True), 1):
        for conv, width in ((1, inner), (2, outer)):
            name, kernel = f"block{block}.conv{conv}", (outer, width, 3, 3)
            if block < 3:
                out[f"{name}.weight"] = kernel
            else:
                out |= {f"{name}.regular_conv.weight": kernel, f"{name}.offset_conv.weight": (18, width, 3, 3)}
                out[f"{name}.offset_conv.bias"] = (18,)
            out |= {f"block{block}.bn{conv}.{x}": (outer,) for x in ("weight", "bias", "running_mean", "running_var")}
        if block > 1:
            out |= {f"block{block}.downsample.weight": (outer, inner, 1, 1), f"block{block}.downsample.bias": (outer,)}
        out[f"conv{block}.weight"] = (dim // 4, outer, 1, 1)
    out |= {f"score_head.{i}.weight": s for i, s in ((0, (8, dim, 1, 1)), (2, (4, 8, 3, 3)), (4, (4, 4, 3, 3)))}
    both = 2 * positions
    return out | {
        "score_head.6.weight": (1, 4, 3, 3),
        "desc_head.agg_weights": (positions, dim, dim),
        "desc_head.offset_conv.0.weight": (both, dim, 3, 3),
        "desc_head.offset_conv.0.bias": (both,),
        "desc_head.offset_conv.2.weight": (both, both, 1, 1),
        "desc_head.offset_conv.2.bias": (both,),
        "desc_head.sf_conv.weight": (dim, dim, 1, 1),
    }


_PUBLISHED = {
    "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085": "aliked-t16.pth",
    "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2": "aliked-n16.pth",
    "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332": "aliked-n16rot.pth",
    "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890": "aliked-n32.pth",
}
MODELS = [
    files.Model(name, _shapes(channels, positions), "BSD 3-Clause, Zhao Xiaoming", _PUBLISHED)
    for name, channels, positions in (
        ("ALIKED-n16", (16, 32, 64, 128), 16),
        ("ALIKED-t16", (8, 16, 32, 64), 16),
        ("ALIKED-n32", (16, 32, 64, 128), 32),
    )
]


def load(weights: Path | None, count: int, upsample: int, device: str) -> Aliked:
    """See `slam.features.named`."""
    return Aliked(files.load(weights, MODELS, hint=HINT, device=device), count, upsample)


class Aliked:
    """See `slam.features.Features`."""

    name, binary = "aliked", False

    def __init__(self, weights: files.Weights, count: int, upsample: int) -> None:
        self.weights, self.count, self.upsample = weights, count, upsample
        self.dimension = weights.model.shapes["desc_head.sf_conv.weight"][0]

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """See `slam.features.Features`."""
        import torch
        from torch.nn.functional import pad

        large, where = enlarged(image, mask, self.upsample)
        height, width = large.shape
        with torch.inference_mode():
            x = torch.from_numpy(np.ascontiguousarray(large)).to(self.weights.device)[None, None].float() / 255
            x = pad(x, (0, -width % SIZE_MULTIPLE_PX, 0, -height % SIZE_MULTIPLE_PX), mode="replicate")
            scores, maps = self._maps(x.expand(-1, 3, -1, -1))
            scores, maps = scores[:height, :width], maps[:, :height, :width]
            peaks = _local_maxima(scores, SUPPRESSION_RADIUS_PX, SUPPRESSION_RADIUS_PX)
            if where is not None:
                peaks *= torch.from_numpy(where > 0).to(peaks.device)
            uv, _ = _strongest(peaks, SCORE_MIN, self.count)
            uv, best = _refined_peaks(scores, uv)
            descriptors = self._describe(maps, uv)
        uv, descriptors, best = uv.cpu().numpy(), descriptors.cpu().numpy(), best.cpu().numpy()
        return unmasked(FeatureSet(reduced(uv, self.upsample), descriptors, best), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return self.weights.describe()

    def _maps(self, x: Any) -> tuple[Any, Any]:
        """(H, W) scores and (D, H, W) feature maps of an image (1, 3, H, W)."""
        import torch
        from torch.nn.functional import avg_pool2d, conv2d, interpolate, normalize, selu

        size, t, parts = x.shape[-2:], self.weights.tensors, []
        for block, pool in enumerate((1, 2, 4, 4), 1):
            x = self._block(block, avg_pool2d(x, pool) if pool > 1 else x)
            part = selu(conv2d(x, t[f"conv{block}.weight"]))
            parts.append(interpolate(part, size, mode="bilinear", align_corners=True) if block > 1 else part)
        maps = torch.cat(parts, dim=1)
        del parts
        scores = selu(conv2d(maps, t["score_head.0.weight"]))
        scores = selu(conv2d(scores, t["score_head.2.weight"], padding=1))
        scores = selu(conv2d(scores, t["score_head.4.weight"], padding=1))
        scores = conv2d(scores, t["score_head.6.weight"], padding=1).sigmoid()
        return scores[0, 0], normalize(maps, dim=1)[0]

    def _block(self, block: int, x: Any) -> Any:
        """Two convolutions; residual from the second block on, deformable from the third on."""
        from torch.nn.functional import batch_norm, conv2d, selu

        t, given = self.weights.tensors, x
        for conv in (1, 2):
            name = f"block{block}.conv{conv}"
            if block < 3:
                x = conv2d(x, t[f"{name}.weight"], padding=1)
            else:
                shifts = conv2d(x, t[f"{name}.offset_conv.weight"], t[f"{name}.offset_conv.bias"], padding=1)
                x = deformed(x, shifts, t[f"{name}.regular_conv.weight"])
            mean, var, weight, bias = (
                t[f"block{block}.bn{conv}.{x}"] for x in ("running_mean", "running_var", "weight", "bias")
            )
            x = batch_norm(x, mean, var, weight, bias)
            if conv == 1 or block == 1:
                x = selu(x)
        if block == 1:
            return x
        return selu(x + conv2d(given, t[f"block{block}.downsample.weight"], t[f"block{block}.downsample.bias"]))

    def _describe(self, maps: Any, uv: Any) -> Any:
        """(N, D) descriptors at pixels (N, 2): sampled at positions around each, predicted from its 3 x 3 patch."""
        import torch
        from torch.nn.functional import conv2d, grid_sample, normalize, selu

        t = self.weights.tensors
        dim, height, width = maps.shape
        if not len(uv):
            return maps.new_zeros(0, dim)
        max_shift = max(height, width) / 4
        steps = torch.arange(-1, 2, device=maps.device)
        u = uv[:, 0].long().clamp(1, width - 2)[:, None, None] + steps[None, None]
        v = uv[:, 1].long().clamp(1, height - 2)[:, None, None] + steps[None, :, None]
        patch = maps[:, v, u].permute(1, 0, 2, 3)  # (N, D, 3, 3)
        shifts = selu(conv2d(patch, t["desc_head.offset_conv.0.weight"], t["desc_head.offset_conv.0.bias"]))
        shifts = conv2d(shifts, t["desc_head.offset_conv.2.weight"], t["desc_head.offset_conv.2.bias"])
        shifts = shifts.clamp(-max_shift, max_shift).reshape(len(uv), 2, -1).transpose(1, 2)
        edge = torch.tensor([width - 1, height - 1], device=maps.device)
        at = (uv[:, None] + shifts) / edge * 2 - 1  # (N, M, 2)
        sampled = grid_sample(maps[None], at[None], mode="bilinear", align_corners=True)  # (1, D, N, M)
        sampled = selu(conv2d(sampled, t["desc_head.sf_conv.weight"]))[0]
        return normalize(torch.einsum("cnm,mcd->nd", sampled, t["desc_head.agg_weights"]), dim=1)


def deformed(x: Any, shifts: Any, kernel: Any) -> Any:
    """Deformable 3 x 3 convolution: each kernel tap is shifted individually at every pixel; zero outside the image.

    Args:
        x: (1, C, H, W) input.
        shifts: (1, 18, H, W) shift down and right of each of the nine taps, row by row, pixels.
        kernel: (D, C, 3, 3) weights.
    """
    import torch
    from torch.nn.functional import conv2d, grid_sample

    height, width = x.shape[-2:]
    max_shift = max(height, width) / 4
    shifts = shifts.clamp(-max_shift, max_shift)
    v, u = torch.meshgrid(
        torch.arange(height, device=x.device, dtype=x.dtype),
        torch.arange(width, device=x.device, dtype=x.dtype),
        indexing="ij",
    )
    out = x.new_zeros(1, len(kernel), height, width)
    for tap in range(9):
        down, right = tap // 3 - 1, tap % 3 - 1
        # without align_corners, pixel centres are also defined for a single row or column
        at_u = (u + right + shifts[0, 2 * tap + 1] + 0.5) / width * 2 - 1
        at_v = (v + down + shifts[0, 2 * tap] + 0.5) / height * 2 - 1
        sampled = grid_sample(x, torch.stack([at_u, at_v], dim=-1)[None], mode="bilinear", align_corners=False)
        out = out + conv2d(sampled, kernel[:, :, down + 1, right + 1, None, None])
    return out


def _refined_peaks(scores: Any, uv: Any) -> tuple[Any, Any]:
    """(N, 2) subpixel positions of the peaks at pixels (N, 2), by soft-argmax, and (N,) their scores."""
    import torch
    from torch.nn.functional import grid_sample

    height, width = scores.shape
    steps = torch.arange(-SUPPRESSION_RADIUS_PX, SUPPRESSION_RADIUS_PX + 1, device=uv.device)
    u, v = uv[:, 0].long()[:, None, None] + steps[None, None], uv[:, 1].long()[:, None, None] + steps[None, :, None]
    share = (scores[v, u].flatten(1) / SOFTMAX_TEMPERATURE).softmax(dim=1).reshape(-1, len(steps), len(steps))
    shift = torch.stack([(share * steps).sum(dim=(1, 2)), (share * steps[:, None]).sum(dim=(1, 2))], dim=1)
    uv = uv + shift
    at = uv / torch.tensor([width - 1, height - 1], device=uv.device) * 2 - 1
    best = grid_sample(scores[None, None], at[None, None], mode="bilinear", align_corners=True)
    return uv, best[0, 0, 0]


def _local_maxima(scores: Any, radius: int, border: int) -> Any:
    """Non-maximum suppression: (H, W) scores, 0 except at maxima within `radius` pixels, and in the border.

    Two more rounds add maxima among the pixels that aren't near a maximum found before, so that of a chain of
    increasing neighbours more than its end remains.
    """
    from torch.nn.functional import max_pool2d

    def largest(x: Any) -> Any:
        return max_pool2d(x, 2 * radius + 1, stride=1, padding=radius)

    x = scores[None, None]
    found = x == largest(x)
    for _ in range(2):
        near = largest(found.to(x)) > 0
        rest = x.masked_fill(near, 0)
        found = found | ((rest == largest(rest)) & ~near)
    out = x.masked_fill(~found, 0)[0, 0]
    out[:border], out[:, :border] = 0, 0
    if border:
        out[-border:], out[:, -border:] = 0, 0
    return out


def _strongest(scores: Any, threshold: float, count: int) -> tuple[Any, Any]:
    """(N, 2) pixels and (N,) scores of the `count` largest scores (H, W) above a threshold, largest first."""
    import torch

    v, u = torch.nonzero(scores > threshold, as_tuple=True)
    best, order = scores[v, u].sort(descending=True, stable=True)
    order = order[:count]
    return torch.stack([u[order], v[order]], dim=1).to(scores), best[:count]
