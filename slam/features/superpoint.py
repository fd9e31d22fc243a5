"""SuperPoint (DeTone et al. 2018), with superpoint_v1.pth supplied by the user; its licence forbids commercial use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.slam import weights as files
from scan2sim.slam.features import FeatureSet, enlarged, reduced, unmasked

CELL_PX = 8
"""Side of the square of pixels that one cell of the network's output covers."""
SUPPRESSION_RADIUS_PX, PROBABILITY_MIN, BORDER_PX = 4, 0.005, 4
"""Radius of non-maximum suppression, least probability, and border without features, as published."""
NEEDS = files.NEEDS
HINT = "Give Magic Leap's superpoint_v1.pth"
_LAYERS = {
    "conv1a": (64, 1, 3, 3), "conv1b": (64, 64, 3, 3),
    "conv2a": (64, 64, 3, 3), "conv2b": (64, 64, 3, 3),
    "conv3a": (128, 64, 3, 3), "conv3b": (128, 128, 3, 3),
    "conv4a": (128, 128, 3, 3), "conv4b": (128, 128, 3, 3),
    "convPa": (256, 128, 3, 3), "convPb": (65, 256, 1, 1),
    "convDa": (256, 128, 3, 3), "convDb": (256, 256, 1, 1),
}  # fmt: skip
MODEL = files.Model(
    "SuperPoint",
    {f"{layer}.weight": shape for layer, shape in _LAYERS.items()}
    | {f"{layer}.bias": shape[:1] for layer, shape in _LAYERS.items()},
    "Magic Leap's, for academic or non-profit noncommercial research only",
    {"52b6708629640ca883673b5d5c097c4ddad37d8048b33f09c8ca0d69db12c40e": "superpoint_v1.pth"},
)


def load(weights: Path | None, count: int, upsample: int, device: str) -> SuperPoint:
    """See `slam.features.named`."""
    return SuperPoint(files.load(weights, [MODEL], hint=HINT, device=device), count, upsample)


class SuperPoint:
    """See `slam.features.Features`."""

    name, binary, dimension = "superpoint", False, 256

    def __init__(self, weights: files.Weights, count: int, upsample: int) -> None:
        self.weights, self.count, self.upsample = weights, count, upsample

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """See `slam.features.Features`."""
        import torch

        large, where = enlarged(image, mask, self.upsample)
        height, width = (n // CELL_PX * CELL_PX for n in large.shape)  # ignores up to 7 rows and columns
        if not height or not width:
            return FeatureSet(np.zeros((0, 2), np.float32), np.zeros((0, 256), np.float32), np.zeros(0, np.float32))
        with torch.inference_mode():
            grey = torch.from_numpy(np.ascontiguousarray(large[:height, :width])).to(self.weights.device)
            scores, coarse = self._maps(grey[None, None].float() / 255)
            scores = local_maxima(scores, SUPPRESSION_RADIUS_PX, BORDER_PX)
            if where is not None:
                scores *= torch.from_numpy(where[:height, :width] > 0).to(scores.device)
            uv, best = strongest(scores, PROBABILITY_MIN, self.count)
            descriptors = self._describe(coarse, uv)
        uv, descriptors, best = uv.cpu().numpy(), descriptors.cpu().numpy(), best.cpu().numpy()
        return unmasked(FeatureSet(reduced(uv, self.upsample), descriptors, best), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return self.weights.describe()

    def _layer(self, name: str, x: Any) -> Any:
        from torch.nn.functional import conv2d

        weight = self.weights.tensors[f"{name}.weight"]
        return conv2d(x, weight, self.weights.tensors[f"{name}.bias"], padding=weight.shape[-1] // 2)

    def _maps(self, x: Any) -> tuple[Any, Any]:
        """(H, W) probabilities and (256, H / 8, W / 8) descriptors of an image (1, 1, H, W)."""
        from torch.nn.functional import max_pool2d, normalize, pixel_shuffle

        for block in "1234":
            x = self._layer(f"conv{block}a", x).relu()
            x = self._layer(f"conv{block}b", x).relu()
            x = max_pool2d(x, 2) if block != "4" else x
        # the last channel is "no feature in this cell"
        probability = self._layer("convPb", self._layer("convPa", x).relu()).softmax(dim=1)[:, :-1]
        descriptors = self._layer("convDb", self._layer("convDa", x).relu())
        return pixel_shuffle(probability, CELL_PX)[0, 0], normalize(descriptors, dim=1)[0]

    def _describe(self, coarse: Any, uv: Any) -> Any:
        """(N, 256) descriptors at pixels (N, 2), interpolated."""
        import torch
        from torch.nn.functional import grid_sample, normalize

        size = torch.tensor([coarse.shape[2], coarse.shape[1]], device=coarse.device)
        # as in training: a cell's descriptor lies at 3.5 of its 8 pixels, with aligned corners
        at = (uv - (CELL_PX - 1) / 2) / (size * CELL_PX - (CELL_PX + 1) / 2) * 2 - 1
        sampled = grid_sample(coarse[None], at[None, None], mode="bilinear", align_corners=True)
        return normalize(sampled[0, :, 0].T, dim=1)


def local_maxima(scores: Any, radius: int, border: int) -> Any:
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


def strongest(scores: Any, threshold: float, count: int) -> tuple[Any, Any]:
    """(N, 2) pixels and (N,) scores of the `count` largest scores (H, W) above a threshold, largest first."""
    import torch

    v, u = torch.nonzero(scores > threshold, as_tuple=True)
    best, order = scores[v, u].sort(descending=True, stable=True)
    order = order[:count]
    return torch.stack([u[order], v[order]], dim=1).to(scores), best[:count]
