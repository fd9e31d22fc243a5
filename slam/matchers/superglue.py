"""SuperGlue (Sarlin et al. 2020) for SuperPoint by `transformers`, with weights from the user.

The licence of the published weights forbids commercial use.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.slam import weights as files
from scan2sim.slam.matchers import NetworkMatcher

PROBABILITY_MIN = 0.2
"""Least probability of a match, as published."""
NEEDS = (*files.NEEDS, "transformers")
HINT = (
    "Give a folder as Hugging Face publishes it: magic-leap-community/superglue_outdoor (or superglue_indoor), "
    "with model.safetensors"
)


def load(weights: Path | None, device: str) -> SuperGlue:
    """See `slam.matchers.named`."""
    from transformers import SuperGlueConfig, SuperGlueForKeypointMatching

    network = SuperGlueForKeypointMatching(SuperGlueConfig(matching_threshold=PROBABILITY_MIN))
    optional = r".*\.num_batches_tracked|keypoint_detector\..*"
    model = files.Model(
        "SuperGlue",
        files.shapes_of(network, optional),
        "Magic Leap's, for academic or non-profit noncommercial research only",
        optional=optional,
    )
    return SuperGlue(files.load(weights, [model], hint=HINT, device=device), network)


class SuperGlue(NetworkMatcher):
    """See `slam.matchers.Matcher`."""

    name, takes, dimension, uses_scores = "superglue", "superpoint", 256, True
