"""Networks as ONNX files; the project's own detector, in and out like an exported YOLOv5, also as safetensors."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import torch

from scan2sim.services.toolboxes.detector.network import STRIDES, VehicleNet

LICENCE = "as the project's"
OPSET = 17
EXAMPLE = (2, 3, 128, 192)


def export(network: VehicleNet, path: Path, names: list[str], facts: dict[str, object]) -> None:
    """Write the network: input `images` (B, 3, H, W) float32 RGB in [0, 1], output `output0` (B, N, 5 + C).

    H and W are multiples of 64. A row is centre x and y, width, height (pixels), objectness, and a score a class.

    Args:
        path: of the ONNX file; weights are written beside it, in half precision, as `.safetensors`.
        facts: further metadata.
    """
    from safetensors.torch import save_file

    state = {name: value for name, value in network.state_dict().items() if value.dtype != torch.int64}
    told = {"network": "VehicleNet", "names": names, "stride": max(STRIDES), "license": LICENCE, **facts}
    varying = {"images": {0: "batch", 2: "height", 3: "width"}, "output0": {0: "batch", 1: "boxes"}}
    write(network, path, torch.zeros(EXAMPLE), varying, told)
    save_file(
        {name: value.half().contiguous() for name, value in state.items()},
        path.with_suffix(".safetensors"),
        _text(told),
    )


def write(
    network: torch.nn.Module,
    path: Path,
    example: torch.Tensor,
    varying: dict[str, dict[int, str]],
    facts: dict[str, object],
) -> None:
    """Write a network of one input and one output as ONNX.

    Args:
        path: of the file.
        example: an input.
        varying: names of input and output, in this order, each with names of its dimensions that vary.
        facts: metadata, kept as text, what is none as JSON.
    """
    import onnx

    path.parent.mkdir(parents=True, exist_ok=True)
    given, found = varying
    with warnings.catch_warnings():  # the exporter that replaces this one needs onnxscript; this one does
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(), (example,), str(path), dynamo=False, opset_version=OPSET,
            input_names=[given], output_names=[found], dynamic_axes=varying,
        )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, _text(facts))
    onnx.save(model, path)


def _text(facts: dict[str, object]) -> dict[str, str]:
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in facts.items()}


def metadata(model: Any) -> dict[str, str]:
    """What an ONNX model tells of itself."""
    return {prop.key: prop.value for prop in model.metadata_props}
