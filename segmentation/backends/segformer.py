"""Backend "segformer": SegFormer B0 to B5 from local files in the format of `transformers`. Nothing is downloaded."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation.backends import NetworkInfo, require_weights, torch_device
from scan2sim.segmentation.huggingface import (
    CONFIG,
    PREPROCESSOR,
    WEIGHTS,
    Normalisation,
    label_names,
    read_json,
    read_normalisation,
)

NEEDS = ("torch", "safetensors", "transformers")
ARCHITECTURE = "SegformerForSemanticSegmentation"
NVIDIA = "NVIDIA's SegFormer weights are for non-commercial use"
MIN_SIDE_PX = 32
"""Smallest side of a photo that the network can take."""
REMEDY = f"Pass a local folder with config.json and {WEIGHTS[0]} of a {ARCHITECTURE}; nothing is downloaded"


def check(weights: Path | None) -> None:
    """See `segmentation.backends.Backend`."""
    require_weights("segformer", weights)


def load(weights: Path | None, device: str) -> Network:
    """The network of a folder (config.json, model.safetensors or pytorch_model.bin), or of a file next to config.json.

    Raises:
        SettingError: torch can't use the device.
        InputError: files are missing, damaged, of another architecture, or a pickle with more than tensors.
    """
    return Network(require_weights("segformer", weights), torch_device(device))


class Network:
    """See `segmentation.backends.Network`; h, w are a quarter of H, W, rounded up."""

    def __init__(self, path: Path, device: str) -> None:
        file = next((path / name for name in WEIGHTS if (path / name).is_file()), path)
        if not file.is_file():
            raise InputError(
                path, f"no {' or '.join(WEIGHTS)} in this folder" if path.is_dir() else "file not found", REMEDY
            )
        config = read_json(file.with_name(CONFIG), REMEDY)
        labels = _labels(config, file.with_name(CONFIG))
        preprocessor = file.with_name(PREPROCESSOR)
        self._normalise = read_normalisation(preprocessor) if preprocessor.is_file() else Normalisation()
        self._device = device
        self._net = _build(config, labels, _state(file), file).eval().to(device)
        name, digest = (path if path.is_dir() else file).name, hashlib.sha256(file.read_bytes()).hexdigest()
        licence = _licence(config, file.with_name("README.md"))
        self.info = NetworkInfo(f"segformer ({name})", labels, digest, licence, None)

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`."""
        import torch
        from torch.nn.functional import interpolate

        with torch.inference_mode():
            try:
                x = torch.from_numpy(self._normalise(seen)).to(self._device).permute(2, 0, 1)[None]
                if min(seen.shape[:2]) < MIN_SIDE_PX:
                    x = interpolate(x, [max(n, MIN_SIDE_PX) for n in seen.shape[:2]], mode="bilinear")
                with torch.autocast("cuda", torch.float16, enabled=self._device.startswith("cuda")):
                    logits = self._net(x).logits
                return np.asarray(logits[0].float().softmax(dim=0).cpu().numpy(), np.float32)
            except torch.cuda.OutOfMemoryError as error:
                torch.cuda.empty_cache()
                raise MemoryError(str(error)) from None


def _labels(config: dict[str, Any], path: Path) -> tuple[str, ...]:
    """Label names by channel from the config of a SegFormer; InputError for another architecture."""
    architectures = config.get("architectures") or [config.get("model_type", "another network")]
    names = [str(name) for name in (architectures if isinstance(architectures, list) else [architectures])]
    if not {ARCHITECTURE, "segformer"} & set(names):
        raise InputError(path, f"config of {', '.join(names)}, not of {ARCHITECTURE}", REMEDY)
    return label_names(config, path)


def _state(path: Path) -> dict[str, Any]:
    """Tensors by name; code in a pickle is not executed."""
    import safetensors.torch
    import torch

    try:
        safe = path.suffix == ".safetensors"
        state = safetensors.torch.load_file(path) if safe else torch.load(path, "cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # damaged files raise many types of exceptions
        code = re.search(r"GLOBAL (\S+)", str(error))
        if code:
            remedy = f"Ask its author for {WEIGHTS[0]}, which can't contain code"
            raise InputError(path, f"contains code or objects besides tensors; not run ({code[1]})", remedy) from None
        why = str(error).rpartition("WeightsUnpickler error:")[2].strip().split("\n")[0] or type(error).__name__
        remedy = f"Copy or download it again, or ask its author for {WEIGHTS[0]}"
        raise InputError(path, f"not a complete file of only tensors ({why})", remedy) from None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError(path, "not a dictionary of tensors", "Save only the network's `state_dict()`")
    return state


def _build(config: dict[str, Any], labels: tuple[str, ...], state: dict[str, Any], path: Path) -> Any:
    import torch
    from transformers import SegformerConfig, SegformerForSemanticSegmentation
    from transformers.utils import logging

    logging.set_verbosity_error()  # mismatches that it warns about are raised as errors below
    logging.disable_progress_bar()
    # Only the architecture's parameters are used: other keys may request remote code. `reshape_last_stage` doesn't
    # change any values, but requires square photos.
    shape = {key: config[key] for key in SegformerConfig.__annotations__ if key in config}
    shape.pop("reshape_last_stage", None)
    try:
        shaped = SegformerConfig(**shape, id2label=dict(enumerate(labels)))
        built: Any = SegformerForSemanticSegmentation.from_pretrained(  # also reads weights of older versions
            None, config=shaped, state_dict=state, dtype=torch.float32, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # an invalid architecture raises many types of exceptions
        why = str(error).strip().split("\n")[0]
        raise InputError(path, f"doesn't match the {ARCHITECTURE} of config.json ({why})", REMEDY) from None
    net, loading = built
    mismatched = sorted({*loading["missing_keys"], *loading["unexpected_keys"]})
    mismatched = [name for name in mismatched if not name.endswith("num_batches_tracked")]
    if mismatched or shaped.num_channels != 3:
        examples = f"{len(mismatched)} weights are missing or unknown, such as {mismatched[0]}" if mismatched else ""
        why = examples or "its input is not RGB"
        raise InputError(path, f"doesn't match the {ARCHITECTURE} of config.json ({why})", REMEDY)
    return net


def _licence(config: dict[str, Any], readme: Path) -> str:
    """Licence of the weights as stated in the config or the front matter of README.md."""
    licence = str(config.get("license") or "")
    if not licence and readme.is_file():
        front = re.match(r"---\n(.*?)\n---", readme.read_text("utf-8-sig", errors="replace"), re.DOTALL)
        lines = re.findall(r"^license(?:_name|_link)?: *(\S.*?) *$", front[1] if front else "", re.MULTILINE)
        licence = ", ".join(line.strip("'\"") for line in lines)
    return f"{licence or 'not stated'}; {NVIDIA}" if licence in ("", "other") else licence
