"""SegFormer B0 to B5 from the user's files, as `transformers` writes them. Nothing is ever downloaded."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation.backends import Facts, given, torch_device

NEEDS = ("torch", "safetensors", "transformers")
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's red, green and blue, 1 for white: what nearly all networks were trained with."""
FILES = ("model.safetensors", "pytorch_model.bin")
ARCHITECTURE = "SegformerForSemanticSegmentation"
NVIDIA = "NVIDIA's SegFormer weights are for non-commercial use"
SMALLEST = 32
"""Pixels of a photo's side; the first stage can't look at less."""
REMEDY = f"Give a folder on this disk with config.json and {FILES[0]} of a {ARCHITECTURE}; nothing is downloaded"


def check(weights: Path | None) -> None:
    """See `segmentation.backends.Backend`."""
    given("segformer", weights)


def load(weights: Path | None, device: str) -> Network:
    """The network of a folder (config.json, model.safetensors or pytorch_model.bin), or of a file beside config.json.

    Raises:
        SettingError: torch can't use the device.
        InputError: they are missing, damaged, of another architecture, or a pickle with more than tensors.
    """
    return Network(given("segformer", weights), torch_device(device))


class Network:
    """See `segmentation.backends.Network`; h, w are a quarter of H, W, rounded up."""

    def __init__(self, path: Path, device: str) -> None:
        file = next((path / name for name in FILES if (path / name).is_file()), path)
        if not file.is_file():
            raise InputError(path, f"has no {' or '.join(FILES)}" if path.is_dir() else "doesn't exist", REMEDY)
        config = _read_json(file.with_name("config.json"))
        labels = _labels(config, file.with_name("config.json"))
        self._scale, self._mean, self._std = _normalisation(file.with_name("preprocessor_config.json"))
        self._device = device
        self._net = _build(config, labels, _state(file), file).eval().to(device)
        name, digest = (path if path.is_dir() else file).name, hashlib.sha256(file.read_bytes()).hexdigest()
        self.facts = Facts(f"segformer ({name})", labels, digest, _licence(config, file.with_name("README.md")), None)

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`."""
        import torch
        from torch.nn.functional import interpolate

        with torch.inference_mode():
            try:
                x = torch.from_numpy(np.ascontiguousarray(seen)).to(self._device).permute(2, 0, 1)[None].float()
                mean, std = (torch.from_numpy(v).to(self._device)[:, None, None] for v in (self._mean, self._std))
                x = (x * self._scale - mean) / std
                if min(seen.shape[:2]) < SMALLEST:
                    x = interpolate(x, [max(n, SMALLEST) for n in seen.shape[:2]], mode="bilinear")
                with torch.autocast("cuda", torch.float16, enabled=self._device.startswith("cuda")):
                    logits = self._net(x).logits
                return np.asarray(logits[0].float().softmax(dim=0).cpu().numpy(), np.float32)
            except torch.cuda.OutOfMemoryError as error:
                torch.cuda.empty_cache()
                raise MemoryError(str(error)) from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        config = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(path, f"can't be read ({error})", REMEDY) from None
    if not isinstance(config, dict):
        raise InputError(path, "is no JSON object", REMEDY)
    return config


def _labels(config: dict[str, Any], path: Path) -> tuple[str, ...]:
    """Names by channel, of a config that is SegFormer's."""
    architectures = config.get("architectures") or [config.get("model_type", "another network")]
    names = [str(name) for name in (architectures if isinstance(architectures, list) else [architectures])]
    if not {ARCHITECTURE, "segformer"} & set(names):
        raise InputError(path, f"is of {', '.join(names)}, not of {ARCHITECTURE}", REMEDY)
    try:
        labels = {int(key): str(name) for key, name in config["id2label"].items()}
    except (KeyError, AttributeError, ValueError):
        labels = {}
    if not labels or sorted(labels) != list(range(len(labels))):
        raise InputError(path, "names no label for every channel from 0 on (id2label)", "Add the labels' names to it")
    return tuple(labels[i] for i in range(len(labels)))


def _normalisation(path: Path) -> tuple[float, F32, F32]:
    """Factor of 0 to 255, and what is then subtracted and divided by; ImageNet's where the file is absent."""
    preprocessor = _read_json(path) if path.is_file() else {}
    (scale,) = numbers(
        [preprocessor.get("rescale_factor", 1 / 255) if preprocessor.get("do_rescale", True) else 1], 1, path
    )
    if not preprocessor.get("do_normalize", True):
        return float(scale), np.zeros(3, np.float32), np.ones(3, np.float32)
    std = numbers(preprocessor.get("image_std", STD), 3, path)
    return float(scale), numbers(preprocessor.get("image_mean", MEAN), 3, path, least=-np.inf), std


def numbers(given: object, n: int, path: Path, least: float = 1e-6) -> F32:
    """(n,) float32 of what a file gives for an image's normalisation; InputError if it isn't n numbers from `least`."""
    try:
        found = np.asarray(given, np.float32)
    except (TypeError, ValueError):
        found = np.empty(0, np.float32)
    if found.shape != (n,) or not np.isfinite(found).all() or found.min() < least:
        raise InputError(path, f"tells {given!r} to normalise photos with", f"Mend it: it should be {n} numbers")
    return found


def _state(path: Path) -> dict[str, Any]:
    """Tensors by name; code that a pickle may hold isn't run."""
    import safetensors.torch
    import torch

    try:
        safe = path.suffix == ".safetensors"
        state = safetensors.torch.load_file(path) if safe else torch.load(path, "cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # damaged files raise a dozen kinds
        code = re.search(r"GLOBAL (\S+)", str(error))
        if code:
            remedy = f"Ask who made it for {FILES[0]}, which can't hold any"
            raise InputError(path, f"holds code or objects besides tensors; not run ({code[1]})", remedy) from None
        why = str(error).rpartition("WeightsUnpickler error:")[2].strip().split("\n")[0] or type(error).__name__
        remedy = f"Copy or download it again, or ask who made it for {FILES[0]}"
        raise InputError(path, f"is no whole file of tensors alone ({why})", remedy) from None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError(path, "holds no tensors by name", "Save the network's `state_dict()` alone")
    return state


def _build(config: dict[str, Any], labels: tuple[str, ...], state: dict[str, Any], path: Path) -> Any:
    import torch
    from transformers import SegformerConfig, SegformerForSemanticSegmentation
    from transformers.utils import logging

    logging.set_verbosity_error()  # what it warns of is an error below
    logging.disable_progress_bar()
    # Only the shape is taken over: other keys may ask for code from elsewhere, and `reshape_last_stage`, which
    # changes no number, for square photos.
    shape = {key: config[key] for key in SegformerConfig.__annotations__ if key in config}
    shape.pop("reshape_last_stage", None)
    try:
        shaped = SegformerConfig(**shape, id2label=dict(enumerate(labels)))
        built: Any = SegformerForSemanticSegmentation.from_pretrained(  # knows the names of older versions
            None, config=shaped, state_dict=state, dtype=torch.float32, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # a shape that makes no sense raises a dozen kinds
        why = str(error).strip().split("\n")[0]
        raise InputError(path, f"doesn't fit the {ARCHITECTURE} that config.json tells of ({why})", REMEDY) from None
    net, loading = built
    strays = sorted({*loading["missing_keys"], *loading["unexpected_keys"]})
    strays = [name for name in strays if not name.endswith("num_batches_tracked")]
    if strays or shaped.num_channels != 3:
        why = f"{len(strays)} weights are missing or unknown, as {strays[0]}" if strays else "it doesn't take RGB"
        raise InputError(path, f"doesn't fit the {ARCHITECTURE} that config.json tells of ({why})", REMEDY)
    return net


def _licence(config: dict[str, Any], readme: Path) -> str:
    """As the config or the front matter of README.md tells."""
    licence = str(config.get("license") or "")
    if not licence and readme.is_file():
        front = re.match(r"---\n(.*?)\n---", readme.read_text("utf-8-sig", errors="replace"), re.DOTALL)
        lines = re.findall(r"^license(?:_name|_link)?: *(\S.*?) *$", front[1] if front else "", re.MULTILINE)
        licence = ", ".join(line.strip("'\"") for line in lines)
    return f"{licence or 'not told'}; {NVIDIA}" if licence in ("", "other") else licence
