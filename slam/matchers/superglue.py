"""SuperGlue (Sarlin et al. 2020) for SuperPoint, with superglue_outdoor.pth or superglue_indoor.pth from the user.

The licence of these weights forbids commercial use.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.slam import weights as files
from scan2sim.slam.features import FeatureSet
from scan2sim.slam.matchers import NetworkMatcher, Sizes

LAYERS, HEADS, DIM = 18, 4, 256
"""Even layers are self-attention, odd layers cross-attention."""
SINKHORN_ITERATIONS, PROBABILITY_MIN = 100, 0.2
"""Iterations of the Sinkhorn normalization, and least probability of a match, as published."""
NEEDS = files.NEEDS
HINT = "Give Magic Leap's superglue_outdoor.pth (or superglue_indoor.pth)"


def _layer(name: str, inner: int, outer: int) -> dict[str, files.Shape]:
    return {f"{name}.weight": (outer, inner, 1), f"{name}.bias": (outer,)}


def _layers(name: str, widths: tuple[int, ...]) -> dict[str, files.Shape]:
    """Shapes of linear layers with batch normalization (and a ReLU, which has no weights) between them."""
    out: dict[str, files.Shape] = {}
    for i, (inner, outer) in enumerate(pairwise(widths)):
        out |= _layer(f"{name}.{3 * i}", inner, outer)
        if i < len(widths) - 2:
            out |= {f"{name}.{3 * i + 1}.{x}": (outer,) for x in ("weight", "bias", "running_mean", "running_var")}
    return out


def _shapes() -> dict[str, files.Shape]:
    out: dict[str, files.Shape] = {"bin_score": (), **_layers("kenc.encoder", (3, 32, 64, 128, 256, DIM))}
    for i in range(LAYERS):
        for name in ("merge", "proj.0", "proj.1", "proj.2"):
            out |= _layer(f"gnn.layers.{i}.attn.{name}", DIM, DIM)
        out |= _layers(f"gnn.layers.{i}.mlp", (2 * DIM, 2 * DIM, DIM))
    return out | _layer("final_proj", DIM, DIM)


MODEL = files.Model(
    "SuperGlue",
    _shapes(),
    "Magic Leap's, for academic or non-profit noncommercial research only",
    {
        "2f5f5e9bb3febf07b69df633c4c3ff7a17f8af26a023aae2b9303d22339195bd": "superglue_outdoor.pth",
        "0e710469be25ebe1e2ccf68edcae8b2945b0617c8e7e68412251d9d47f5052b1": "superglue_indoor.pth",
    },
)


def load(weights: Path | None, device: str) -> SuperGlue:
    """See `slam.matchers.named`."""
    return SuperGlue(files.load(weights, [MODEL], hint=HINT, device=device))


class SuperGlue(NetworkMatcher):
    """See `slam.matchers.Matcher`."""

    name, takes, dimension, probability_min = "superglue", "superpoint", DIM, PROBABILITY_MIN

    def probabilities(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> Any:
        """See `slam.matchers.NetworkMatcher`."""
        xa, xb = self._encoded(a, sizes[0]), self._encoded(b, sizes[1])
        for i in range(LAYERS):
            sources = (xb, xa) if i % 2 else (xa, xb)
            xa, xb = xa + self._attend(i, xa, sources[0]), xb + self._attend(i, xb, sources[1])
        scores = self._layer("final_proj", xa).T @ self._layer("final_proj", xb) / math.sqrt(DIM)
        return sinkhorn(scores, self.weights.tensors["bin_score"], SINKHORN_ITERATIONS)[:-1, :-1]

    def _encoded(self, found: FeatureSet, size: tuple[int, int]) -> Any:
        """(D, N) descriptors plus the encoding of their positions and scores."""
        import torch

        half = np.array(size, np.float32) / 2
        at = torch.from_numpy((found.uv - half) / (1.4 * half.max())).to(self.weights.device)
        descriptors, scores = (torch.from_numpy(x).to(self.weights.device) for x in (found.descriptors, found.scores))
        return descriptors.T + self._stack("kenc.encoder", 5, torch.cat([at, scores[:, None]], dim=1).T)

    def _layer(self, name: str, x: Any) -> Any:
        t = self.weights.tensors
        return t[f"{name}.weight"][..., 0] @ x + t[f"{name}.bias"][:, None]

    def _stack(self, name: str, count: int, x: Any) -> Any:
        """Linear layers with batch normalization and ReLU between them."""
        from torch.nn.functional import batch_norm

        t = self.weights.tensors
        for i in range(count):
            x = self._layer(f"{name}.{3 * i}", x)
            if i < count - 1:
                norm = f"{name}.{3 * i + 1}"
                mean, var, weight, bias = (t[f"{norm}.{x}"] for x in ("running_mean", "running_var", "weight", "bias"))
                x = batch_norm(x.T, mean, var, weight, bias).T.relu()
        return x

    def _attend(self, i: int, x: Any, source: Any) -> Any:
        """(D, N) message to features x from features `source`, by attention."""
        import torch
        from torch.nn.functional import scaled_dot_product_attention

        name = f"gnn.layers.{i}.attn"
        query, key, value = (
            self._layer(f"{name}.proj.{k}", y).reshape(DIM // HEADS, HEADS, -1).permute(1, 2, 0)
            for k, y in enumerate((x, source, source))
        )
        message = scaled_dot_product_attention(query, key, value).permute(2, 0, 1).reshape(DIM, -1)
        return self._stack(f"gnn.layers.{i}.mlp", 2, torch.cat([x, self._layer(f"{name}.merge", message)]))


def sinkhorn(scores: Any, no_match: Any, iterations: int) -> Any:
    """(N + 1, M + 1) probabilities from scores (N, M), by Sinkhorn normalization; last row and column: no match.

    Args:
        scores: (N, M) tensor.
        no_match: score of "no match", a tensor of one number.
        iterations: number of row and column normalizations.
    """
    import torch

    n, m = scores.shape
    full = no_match.expand(n + 1, m + 1).clone()
    full[:n, :m] = scores
    rows, columns = full.new_zeros(n + 1), full.new_zeros(m + 1)
    rows[n], columns[m] = math.log(m), math.log(n)
    u, v = torch.zeros_like(rows), torch.zeros_like(columns)
    for _ in range(iterations):
        u = rows - torch.logsumexp(full + v, dim=1)
        v = columns - torch.logsumexp(full + u[:, None], dim=0)
    return (full + u[:, None] + v).exp()
