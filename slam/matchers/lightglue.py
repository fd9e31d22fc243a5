"""LightGlue (Lindenberger et al. 2023) for SuperPoint or ALIKED by `transformers`, with weights from the user.

All layers are run for all features, without early stopping and pruning: these save time on similar images, but change
the matches.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scan2sim.slam import weights as files
from scan2sim.slam.matchers import NetworkMatcher

HEADS = 4
PROBABILITY_MIN = 0.1
"""Least probability of a match, as published."""
NEEDS = (*files.NEEDS, "transformers")
HINT = (
    "Give a folder as Hugging Face publishes it: ETH-CVG/lightglue_superpoint, with model.safetensors; "
    "or LightGlue's superpoint_lightglue.pth or aliked_lightglue.pth"
)
UNUSED = r"token_confidence\..*|confidence_thresholds|match_assignment_layers\.[0-7]\..*"
"""Tensors that only early stopping and pruning use."""
DETECTOR = r"keypoint_detector\..*"
"""SuperPoint's tensors, which a folder of Hugging Face contains, too."""
RENAMES = (
    (r"^posenc\.Wr\.", "positional_encoder.projector."),
    (r"^input_proj\.", "input_projection."),
    (r"^log_assignment\.", "match_assignment_layers."),
    (r"\.final_proj\.", ".final_projection."),
    (r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1."),  # the files' names, and those of LightGlue's code
    (r"^transformers\.(\d+)\.(self|cross)_attn\.ffn\.0\.", r"transformer_layers.\1.\2_mlp.fc1."),
    (r"^transformers\.(\d+)\.(self|cross)_attn\.ffn\.1\.", r"transformer_layers.\1.\2_mlp.layer_norm."),
    (r"^transformers\.(\d+)\.(self|cross)_attn\.ffn\.3\.", r"transformer_layers.\1.\2_mlp.fc2."),
    (r"^transformers\.(\d+)\.(self|cross)_attn\.", r"transformer_layers.\1.\2_attention."),
    (r"\.(out_proj|to_out)\.", ".o_proj."),
    (r"\.to_v\.", ".v_proj."),
)
"""Names of tensors in LightGlue's .pth files, and of `transformers`."""


def load(weights: Path | None, device: str) -> LightGlue:
    """See `slam.matchers.named`."""
    superpoint, aliked = _network(256), _network(128)
    models = [
        files.Model(
            "LightGlue for SuperPoint",
            files.shapes_of(superpoint, f"{DETECTOR}|{UNUSED}"),
            "Apache 2.0, ETH Zurich (the SuperPoint that it needs is for noncommercial research only)",
            {"6ff7040d0a497fc6639337946d7538dae07428c18f77a067a0b5a960e7cc551a": "superpoint_lightglue.pth, v0.1"},
            optional=f"{DETECTOR}|{UNUSED}",
            convert=_converted,
        ),
        files.Model(
            "LightGlue for ALIKED",
            files.shapes_of(aliked, f"{DETECTOR}|{UNUSED}"),
            "Apache 2.0, ETH Zurich",
            {"d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503": "aliked_lightglue.pth, v0.1"},
            optional=UNUSED,
            convert=_converted,
        ),
    ]
    loaded = files.load(weights, models, hint=HINT, device=device)
    return LightGlue(loaded, superpoint if loaded.model is models[0] else aliked)


def _network(dimension: int) -> Any:
    """The network for descriptors of a dimension, without early stopping and pruning."""
    from transformers import LightGlueConfig, LightGlueForKeypointMatching, SuperPointConfig

    return LightGlueForKeypointMatching(
        LightGlueConfig(
            keypoint_detector_config=SuperPointConfig(descriptor_decoder_dim=dimension),
            depth_confidence=-1.0,
            width_confidence=-1.0,
            filter_threshold=PROBABILITY_MIN,
        )
    )


class LightGlue(NetworkMatcher):
    """See `slam.matchers.Matcher`."""

    name, uses_scores = "lightglue", False

    def __init__(self, weights: files.Weights, network: Any) -> None:
        super().__init__(weights, network)
        self.dimension = network.keypoint_detector_descriptor_dim
        self.takes = "superpoint" if self.dimension == 256 else "aliked"


def _converted(state: dict[str, Any]) -> dict[str, Any]:
    """Tensors of LightGlue's .pth files by the names of `transformers`, which has a tensor each for q, k and v."""
    out: dict[str, Any] = {}
    for name, value in files.renamed(state, RENAMES).items():
        if ".Wqkv." in name:
            value = value.unflatten(0, (HEADS, -1, 3))
            out |= {name.replace("Wqkv", f"{part}_proj"): value[:, :, i].flatten(0, 1) for i, part in enumerate("qkv")}
        elif ".to_qk." in name:
            out |= {name.replace("to_qk", f"{part}_proj"): value for part in "qk"}
        else:
            out[name] = value
    return out
