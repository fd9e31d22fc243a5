"""The project's own network, trained on the synthetic street: the default, which needs no download."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from pathlib import Path
from typing import TYPE_CHECKING

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.types import F32, U8
from scan2sim.segmentation.backends import Facts, torch_device

if TYPE_CHECKING:
    from scan2sim.segmentation.network import StreetNet

OWN = Path(__file__).resolve().parent.parent / "weights" / "street.safetensors"


def available() -> str | None:
    """What to install, or None."""
    missing = [name for name in ("torch", "safetensors") if importlib.util.find_spec(name) is None]
    return ", ".join(missing) or None


def save(network: StreetNet, path: Path, told: dict[str, object]) -> None:
    """Write weights in half precision, with their labels and what is told of their training."""
    import torch
    from safetensors.torch import save_file

    from scan2sim.segmentation.labels import CLASSES

    halves = {
        name: value.half() if value.is_floating_point() else value for name, value in network.state_dict().items()
    }
    halves = {name: value.contiguous() for name, value in halves.items() if value.dtype != torch.int64}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(halves, str(path), {"network": "StreetNet", "labels": json.dumps(CLASSES), **_texts(told)})


def _texts(told: dict[str, object]) -> dict[str, str]:
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in told.items()}


def load(weights: Path | None, device: str) -> Network:
    """The network with the project's own weights, or others that `scan2sim segment train` wrote."""
    return Network(weights or OWN, torch_device(device))


class Network:
    """See `segmentation.backends.Network`."""

    def __init__(self, path: Path, device: str) -> None:
        from safetensors import SafetensorError, safe_open

        from scan2sim.segmentation.network import PIXELS_A_RADIAN, StreetNet

        remedy = "Give weights that `scan2sim segment train` wrote, or leave `label.weights` out"
        try:
            with safe_open(str(path), "pt") as file:
                told = file.metadata() or {}
                state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        except (OSError, SafetensorError) as error:
            raise InputError(path, f"is no whole safetensors file ({error})", remedy) from None
        if told.get("network") != "StreetNet" or "labels" not in told:
            raise InputError(path, f"holds weights of {told.get('network', 'another network')}, not StreetNet", remedy)
        labels = tuple(json.loads(told["labels"]))
        self._net = StreetNet(len(labels))
        try:
            missing, unknown = self._net.load_state_dict(state, strict=False)
        except RuntimeError as error:
            raise InputError(path, f"doesn't fit StreetNet ({str(error).splitlines()[-1].strip()})", remedy) from None
        if unknown or [name for name in missing if not name.endswith("num_batches_tracked")]:
            raise InputError(path, "lacks weights of StreetNet, or has others", remedy)
        self._device = device
        self._net.eval().to(device)
        self.facts = Facts(f"street ({path.name})", labels, digest, "as the project's", PIXELS_A_RADIAN)

    def probabilities(self, rgb: U8) -> F32:
        """See `segmentation.backends.Network`."""
        import numpy as np
        import torch

        with torch.inference_mode():
            try:
                x = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float() / 255
                with torch.autocast("cuda", torch.float16, enabled=self._device.startswith("cuda")):
                    logits = self._net(x.contiguous(memory_format=torch.channels_last))
                return np.asarray(logits[0].float().softmax(dim=0).cpu().numpy(), np.float32)
            except torch.cuda.OutOfMemoryError as error:
                torch.cuda.empty_cache()
                raise MemoryError(str(error)) from None
