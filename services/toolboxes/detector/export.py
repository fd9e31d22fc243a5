"""Export of networks as ONNX; the project's own detector in the form of an exported YOLOv5, also as safetensors."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from scan2sim.services.toolboxes.detector.network import STRIDES, VehicleNet

LICENCE = "as the project's"
OPSET = 17
EXAMPLE_SHAPE = (2, 3, 128, 192)


def export(network: VehicleNet, path: Path, names: list[str], metadata: dict[str, object]) -> None:
    """Export the detector: input `images` (B, 3, H, W) float32 RGB in [0, 1], output `output0` (B, N, 5 + C).

    H and W are multiples of 64. A row is centre x and y, width, height (pixels), objectness, and a score per class.

    Args:
        path: ONNX file to write; the weights are written beside it in half precision as `.safetensors`.
        names: names of the classes.
        metadata: additional metadata.
    """
    from safetensors.torch import save_file

    state = {name: value for name, value in network.state_dict().items() if value.dtype != torch.int64}
    metadata = {"network": "VehicleNet", "names": names, "stride": max(STRIDES), "license": LICENCE, **metadata}
    dynamic_axes = {"images": {0: "batch", 2: "height", 3: "width"}, "output0": {0: "batch", 1: "boxes"}}
    write_onnx(network, path, torch.zeros(EXAMPLE_SHAPE), dynamic_axes, metadata)
    save_file(
        {name: value.half().contiguous() for name, value in state.items()},
        path.with_suffix(".safetensors"),
        _as_strings(metadata),
    )


def write_onnx(
    network: torch.nn.Module,
    path: Path,
    example: torch.Tensor,
    dynamic_axes: dict[str, dict[int, str]],
    metadata: dict[str, object],
) -> None:
    """Export a network with one input and one output as ONNX.

    Args:
        network: network to export.
        path: file to write.
        example: example input.
        dynamic_axes: names of the input and the output, in this order, with the names of their dynamic dimensions.
        metadata: stored as strings; other values are serialized as JSON.
    """
    import onnx

    path.parent.mkdir(parents=True, exist_ok=True)
    input_name, output_name = dynamic_axes
    with warnings.catch_warnings():  # this exporter is deprecated, but its successor requires onnxscript
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(), (example,), str(path), dynamo=False, opset_version=OPSET,
            input_names=[input_name], output_names=[output_name], dynamic_axes=dynamic_axes,
        )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, _as_strings(metadata))
    onnx.save(model, path)


def read_thresholds(path: Path) -> dict[str, float]:
    """Minimum score by class in the metadata of an ONNX file; empty if it has none."""
    import onnx

    found: dict[str, float] = json.loads(read_metadata(onnx.load(path)).get("thresholds", "{}"))
    return found


def write_thresholds(path: Path, thresholds: Mapping[str, float]) -> None:
    """Set the minimum score by class in the metadata of an ONNX file, by which `toolbox detect` reports detections."""
    import onnx

    model = onnx.load(path)
    onnx.helper.set_model_props(model, read_metadata(model) | {"thresholds": json.dumps(dict(thresholds))})
    onnx.save(model, path)


def _as_strings(metadata: dict[str, object]) -> dict[str, str]:
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}


def read_metadata(model: Any) -> dict[str, str]:
    """Metadata of an ONNX model."""
    return {prop.key: prop.value for prop in model.metadata_props}
