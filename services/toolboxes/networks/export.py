"""The project's own detector as files: ONNX, in and out like an exported YOLOv5, and safetensors to go on from."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import torch

from scan2sim.services.toolboxes.networks.network import STRIDES, VehicleNet

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
    import onnx
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    state = {name: value for name, value in network.state_dict().items() if value.dtype != torch.int64}
    told = {"network": "VehicleNet", "names": names, "stride": max(STRIDES), "license": LICENCE, **facts}
    props = {key: value if isinstance(value, str) else json.dumps(value) for key, value in told.items()}
    save_file(
        {name: value.half().contiguous() for name, value in state.items()}, path.with_suffix(".safetensors"), props
    )
    with warnings.catch_warnings():  # the exporter that replaces this one needs onnxscript; this one does
        warnings.simplefilter("ignore")
        axes = {0: "batch", 2: "height", 3: "width"}
        torch.onnx.export(
            network.eval(), (torch.zeros(EXAMPLE),), str(path), dynamo=False, opset_version=OPSET,
            input_names=["images"], output_names=["output0"],
            dynamic_axes={"images": axes, "output0": {0: "batch", 1: "boxes"}},
        )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, props)
    onnx.save(model, path)


def metadata(model: Any) -> dict[str, str]:
    """What an ONNX model tells of itself."""
    return {prop.key: prop.value for prop in model.metadata_props}
