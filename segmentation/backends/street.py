"""Backend "street": the project's own network, trained on synthetic streets; the default, which needs no download.

Its weights come in two formats: ONNX, run by onnxruntime on any CPU, and safetensors, run by torch if there is a GPU.
`scan2sim segment train` writes both.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation.backends import Network as AnyNetwork
from scan2sim.segmentation.backends import NetworkInfo, onnx, require_weights, torch_device
from scan2sim.segmentation.lidar_channels import CHANNELS

if TYPE_CHECKING:
    from scan2sim.segmentation.network import StreetNet

NEEDS = onnx.NEEDS
DEFAULT_WEIGHTS = Path(__file__).resolve().parent.parent / "weights" / "street.onnx"
LICENCE = "as the project's"
OPSET = 17


def check(weights: Path | None) -> None:
    """See `segmentation.backends.Backend`; without weights, the project's own are used."""
    if weights is not None and _is_safetensors(weights):
        optional_deps.require("label.network street", "torch", "safetensors")
    if weights is not None:
        require_weights("street", weights)


def load(weights: Path | None, device: str) -> AnyNetwork:
    """The network with the project's own weights, or with others written by `scan2sim segment train`."""
    if weights is None:
        weights = DEFAULT_WEIGHTS.with_suffix(".safetensors") if _uses_gpu(device) else DEFAULT_WEIGHTS
    if _is_safetensors(weights):
        return Network(weights, torch_device(device))
    return onnx.Network(weights, device, "street")


def _is_safetensors(weights: Path) -> bool:
    return weights.suffix != ".onnx"


def _uses_gpu(device: str) -> bool:
    """Whether the device is a GPU that torch can use."""
    return device != "cpu" and not optional_deps.missing("torch", "safetensors") and torch_device(device) != "cpu"


def save(network: StreetNet, path: Path, metadata: dict[str, object]) -> None:
    """Write weights in half precision, with their labels and metadata of their training.

    Args:
        network: trained network.
        path: path of the ONNX file; a file with the suffix `.safetensors` is written next to it.
        metadata: entries added to the files' metadata.
    """
    import torch
    from safetensors.torch import save_file

    from scan2sim.segmentation.labels import CLASSES

    state = {name: value for name, value in network.state_dict().items() if value.dtype != torch.int64}
    halves = {name: value.half().contiguous() for name, value in state.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    entries = {"network": "StreetNet", "labels": CLASSES, **metadata}
    save_file(halves, str(path.with_suffix(".safetensors")), {key: _text(value) for key, value in entries.items()})
    network.load_state_dict({name: value.float() for name, value in halves.items()}, strict=False)
    _export(network, path, entries)


def _export(network: StreetNet, path: Path, entries: dict[str, Any]) -> None:
    """Write the network as ONNX for `backends.onnx`; it normalises photos itself."""
    import onnx as files
    import torch

    from scan2sim.segmentation.network import PIXELS_PER_RADIAN

    with warnings.catch_warnings():  # deprecation: the new exporter needs onnxscript, the old one is sufficient
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(), (torch.zeros(1, 3 + CHANNELS, 64, 96),), str(path), dynamo=False, opset_version=OPSET,
            input_names=["image"], output_names=["logits"],
            dynamic_axes={"image": {2: "height", 3: "width"}, "logits": {2: "h", 3: "w"}},
        )  # fmt: skip
    model = files.load(path)
    inputs = {"mean": [0, 0, 0], "std": [1, 1, 1], "pixels_a_radian": PIXELS_PER_RADIAN, "license": LICENCE}
    inputs["channels"] = True
    files.helper.set_model_props(model, {key: _text(value) for key, value in (entries | inputs).items()})
    files.save(model, path)


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


class Network:
    """See `segmentation.backends.Network`; runs the safetensors weights by torch."""

    def __init__(self, path: Path, device: str) -> None:
        from safetensors import SafetensorError, safe_open

        from scan2sim.segmentation.network import PIXELS_PER_RADIAN, StreetNet

        remedy = "Pass weights written by `scan2sim segment train`, or leave `label.weights` unset"
        try:
            with safe_open(str(path), "pt") as file:
                metadata = file.metadata() or {}
                state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        except (OSError, SafetensorError) as error:
            raise InputError(path, f"not a complete safetensors file ({error})", remedy) from None
        if metadata.get("network") != "StreetNet" or "labels" not in metadata:
            raise InputError(
                path, f"contains weights of {metadata.get('network', 'another network')}, not StreetNet", remedy
            )
        labels = tuple(json.loads(metadata["labels"]))
        self._net = StreetNet(len(labels))
        try:
            missing, unknown = self._net.load_state_dict(state, strict=False)
        except RuntimeError as error:
            raise InputError(path, f"doesn't match StreetNet ({str(error).splitlines()[-1].strip()})", remedy) from None
        if unknown or [name for name in missing if not name.endswith("num_batches_tracked")]:
            raise InputError(path, "doesn't match StreetNet: weights are missing or unknown", remedy)
        self._device = device
        self._net.eval().to(device)
        self.info = NetworkInfo(f"street ({path.name})", labels, digest, LICENCE, PIXELS_PER_RADIAN, channels=True)

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`."""
        import torch

        with torch.inference_mode():
            try:
                x = torch.from_numpy(np.ascontiguousarray(seen)).to(self._device).permute(2, 0, 1)[None].float() / 255
                with torch.autocast("cuda", torch.float16, enabled=self._device.startswith("cuda")):
                    logits = self._net(x.contiguous(memory_format=torch.channels_last))
                return np.asarray(logits[0].float().softmax(dim=0).cpu().numpy(), np.float32)
            except torch.cuda.OutOfMemoryError as error:
                torch.cuda.empty_cache()
                raise MemoryError(str(error)) from None
