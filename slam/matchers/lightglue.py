"""LightGlue (Lindenberger et al. 2023), with superpoint_lightglue.pth or aliked_lightglue.pth supplied by the user.

All layers are run for all features, without early stopping and pruning: these save time on similar images, but change
the matches.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.slam import weights as files
from scan2sim.slam.features import FeatureSet
from scan2sim.slam.matchers import NetworkMatcher, Sizes

LAYERS, HEADS, DIM = 9, 4, 256
PROBABILITY_MIN = 0.1
"""Least probability of a match, as published."""
NEEDS = files.NEEDS
HINT = "Give LightGlue's superpoint_lightglue.pth or aliked_lightglue.pth"


def _linear(name: str, inner: int, outer: int) -> dict[str, files.Shape]:
    return {f"{name}.weight": (outer, inner), f"{name}.bias": (outer,)}


def _shapes(dimension: int) -> dict[str, files.Shape]:
    out: dict[str, files.Shape] = {"posenc.Wr.weight": (DIM // HEADS // 2, 2)}
    if dimension != DIM:
        out |= _linear("input_proj", dimension, DIM)
    for i in range(LAYERS):
        own, across = f"transformers.{i}.self_attn", f"transformers.{i}.cross_attn"
        out |= _linear(f"{own}.Wqkv", DIM, 3 * DIM) | _linear(f"{own}.out_proj", DIM, DIM)
        for name in ("to_qk", "to_v", "to_out"):
            out |= _linear(f"{across}.{name}", DIM, DIM)
        for name in (own, across):
            out |= _linear(f"{name}.ffn.0", 2 * DIM, 2 * DIM) | _linear(f"{name}.ffn.3", 2 * DIM, DIM)
            out |= {f"{name}.ffn.1.weight": (2 * DIM,), f"{name}.ffn.1.bias": (2 * DIM,)}
    last = f"log_assignment.{LAYERS - 1}"
    return out | _linear(f"{last}.matchability", DIM, 1) | _linear(f"{last}.final_proj", DIM, DIM)


def _model(features: str, dimension: int, published: dict[str, str], licence: str) -> files.Model:
    return files.Model(
        f"LightGlue for {features}",
        _shapes(dimension),
        licence,
        published,
        optional=r"confidence_thresholds|token_confidence\..*|log_assignment\..*",
        renames=((r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1."),),  # the published files' names
    )


_SUPERPOINT = _model(
    "SuperPoint",
    DIM,
    {"6ff7040d0a497fc6639337946d7538dae07428c18f77a067a0b5a960e7cc551a": "superpoint_lightglue.pth, v0.1"},
    "Apache 2.0, ETH Zurich (the SuperPoint that it needs is for noncommercial research only)",
)
_ALIKED = _model(
    "ALIKED",
    128,
    {"d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503": "aliked_lightglue.pth, v0.1"},
    "Apache 2.0, ETH Zurich",
)


def load(weights: Path | None, device: str) -> LightGlue:
    """See `slam.matchers.named`."""
    return LightGlue(files.load(weights, [_SUPERPOINT, _ALIKED], hint=HINT, device=device))


class LightGlue(NetworkMatcher):
    """See `slam.matchers.Matcher`."""

    name, probability_min = "lightglue", PROBABILITY_MIN

    def __init__(self, weights: files.Weights) -> None:
        super().__init__(weights)
        self.takes, self.dimension = ("aliked", 128) if "input_proj.weight" in weights.tensors else ("superpoint", DIM)

    def probabilities(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> Any:
        """See `slam.matchers.NetworkMatcher`."""
        from torch.nn.functional import logsigmoid

        (xa, encoding_a), (xb, encoding_b) = self._encoded(a, sizes[0]), self._encoded(b, sizes[1])
        for i in range(LAYERS):
            xa, xb = self._self_attention(i, xa, encoding_a), self._self_attention(i, xb, encoding_b)
            xa, xb = self._cross_attention(i, xa, xb)
        last = f"log_assignment.{LAYERS - 1}"
        scores = self._linear(f"{last}.final_proj", xa) @ self._linear(f"{last}.final_proj", xb).T / math.sqrt(DIM)
        log_probability = scores.log_softmax(dim=1) + scores.log_softmax(dim=0)
        for x, of_columns in ((xa, False), (xb, True)):
            matchability = logsigmoid(self._linear(f"{last}.matchability", x))
            log_probability = log_probability + (matchability.T if of_columns else matchability)
        return log_probability.exp()

    def _encoded(self, found: FeatureSet, size: tuple[int, int]) -> tuple[Any, Any]:
        """(N, D) descriptors, and their rotary positional encoding: cosines and sines (2, N, D / HEADS)."""
        import torch

        half = np.array(size, np.float32) / 2
        at = torch.from_numpy((found.uv - half) / half.max()).to(self.weights.device)
        x = torch.from_numpy(found.descriptors).to(self.weights.device)
        if self.dimension != DIM:
            x = self._linear("input_proj", x)
        angle = (at @ self.weights.tensors["posenc.Wr.weight"].T).repeat_interleave(2, dim=1)
        return x, torch.stack([angle.cos(), angle.sin()])

    def _linear(self, name: str, x: Any) -> Any:
        from torch.nn.functional import linear

        return linear(x, self.weights.tensors[f"{name}.weight"], self.weights.tensors[f"{name}.bias"])

    def _updated(self, name: str, x: Any, message: Any) -> Any:
        """Features (N, D) updated by an attention message (N, D)."""
        import torch
        from torch.nn.functional import gelu, layer_norm

        t = self.weights.tensors
        inner = self._linear(f"{name}.ffn.0", torch.cat([x, message], dim=1))
        inner = layer_norm(inner, inner.shape[1:], t[f"{name}.ffn.1.weight"], t[f"{name}.ffn.1.bias"])
        return x + self._linear(f"{name}.ffn.3", gelu(inner))

    def _self_attention(self, i: int, x: Any, encoding: Any) -> Any:
        """Features (N, D) after self-attention, within the image."""
        from torch.nn.functional import scaled_dot_product_attention

        name = f"transformers.{i}.self_attn"
        query, key, value = self._linear(f"{name}.Wqkv", x).reshape(len(x), HEADS, -1, 3).permute(3, 1, 0, 2)
        message = scaled_dot_product_attention(_rotated(query, encoding), _rotated(key, encoding), value)
        return self._updated(name, x, self._linear(f"{name}.out_proj", message.transpose(0, 1).reshape(len(x), DIM)))

    def _cross_attention(self, i: int, xa: Any, xb: Any) -> tuple[Any, Any]:
        """Features of both images after cross-attention to the other image."""
        from torch.nn.functional import scaled_dot_product_attention

        name = f"transformers.{i}.cross_attn"
        keys, values = (
            [self._linear(f"{name}.{part}", x).reshape(len(x), HEADS, -1).transpose(0, 1) for x in (xa, xb)]
            for part in ("to_qk", "to_v")
        )
        out = []
        for x, own, other in ((xa, 0, 1), (xb, 1, 0)):
            message = scaled_dot_product_attention(keys[own], keys[other], values[other])
            out.append(
                self._updated(name, x, self._linear(f"{name}.to_out", message.transpose(0, 1).reshape(len(x), DIM)))
            )
        return out[0], out[1]


def _rotated(x: Any, encoding: Any) -> Any:
    """(HEADS, N, K) rotary encoding: each pair of numbers is rotated by the angle of its position."""
    import torch

    even, odd = x[..., ::2], x[..., 1::2]
    return x * encoding[0] + torch.stack([-odd, even], dim=-1).flatten(-2) * encoding[1]
