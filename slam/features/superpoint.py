"""SuperPoint (DeTone et al. 2018) by `transformers`, with weights from the user.

The licence of the published weights forbids commercial use.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.slam import weights as files
from scan2sim.slam.features import FeatureSet, enlarged, reduced, unmasked

CELL_PX, DIM = 8, 256
"""Side of the square of pixels that one cell of the network's output covers, and dimension of the descriptors."""
SUPPRESSION_RADIUS_PX, PROBABILITY_MIN, BORDER_PX = 4, 0.005, 4
"""Radius of non-maximum suppression, least probability, and border without features, as published."""
NEEDS = (*files.NEEDS, "transformers")
HINT = (
    "Give a folder as Hugging Face publishes it: magic-leap-community/superpoint, with model.safetensors; "
    "or Magic Leap's superpoint_v1.pth"
)
RENAMES = (
    (r"^conv(\d)([ab])", lambda name: f"encoder.conv_blocks.{int(name[1]) - 1}.conv_{name[2]}"),
    (r"^convP([ab])", r"keypoint_decoder.conv_score_\1"),
    (r"^convD([ab])", r"descriptor_decoder.conv_descriptor_\1"),
)
"""Names of tensors in superpoint_v1.pth, and of `transformers`."""


def load(weights: Path | None, count: int, upsample: int, device: str) -> SuperPoint:
    """See `slam.features.named`."""
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

    config = SuperPointConfig(
        keypoint_threshold=PROBABILITY_MIN, nms_radius=SUPPRESSION_RADIUS_PX, border_removal_distance=BORDER_PX
    )
    network = SuperPointForKeypointDetection(config)
    model = files.Model(
        "SuperPoint",
        files.shapes_of(network),
        "Magic Leap's, for academic or non-profit noncommercial research only",
        {"52b6708629640ca883673b5d5c097c4ddad37d8048b33f09c8ca0d69db12c40e": "superpoint_v1.pth"},
        convert=lambda state: files.renamed(state, RENAMES),
    )
    return SuperPoint(files.load(weights, [model], hint=HINT, device=device), network, count, upsample)


class SuperPoint:
    """See `slam.features.Features`."""

    name, binary, dimension = "superpoint", False, DIM

    def __init__(self, weights: files.Weights, network: Any, count: int, upsample: int) -> None:
        self.weights, self.network, self.count, self.upsample = weights, weights.set_in(network), count, upsample

    def detect(self, image: U8, mask: U8 | None = None) -> FeatureSet:
        """See `slam.features.Features`."""
        import torch

        large, where = enlarged(image, mask, self.upsample)
        height, width = (n // CELL_PX * CELL_PX for n in large.shape)  # ignores up to 7 rows and columns
        none = FeatureSet(np.zeros((0, 2), np.float32), np.zeros((0, DIM), np.float32), np.zeros(0, np.float32))
        if not height or not width:
            return none
        with torch.inference_mode():
            grey = torch.from_numpy(np.ascontiguousarray(large[:height, :width])).to(self.weights.device)
            encoded = self.network.encoder(grey[None, None].float() / 255)[0]
            uv, scores = self.network.keypoint_decoder(encoded)
            # transformers removes features from the left and upper border only
            keep = (uv < uv.new_tensor([width - BORDER_PX, height - BORDER_PX])).all(dim=1)
            if where is not None:
                u, v = uv.long().T
                keep &= torch.from_numpy(where[:height, :width] > 0).to(uv.device)[v, u]
            best, order = scores[keep].sort(descending=True, stable=True)
            uv, best = uv[keep][order[: self.count]], best[: self.count]
            if not len(uv):
                return none
            descriptors = self.network.descriptor_decoder(encoded, uv[None])
        uv, descriptors, best = uv.cpu().numpy(), descriptors.cpu().numpy(), best.cpu().numpy()
        return unmasked(FeatureSet(reduced(uv, self.upsample), descriptors, best), mask)

    def describe(self) -> str:
        """See `slam.features.Features`."""
        return self.weights.describe()
