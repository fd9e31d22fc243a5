"""What Hugging Face writes beside a network: label names in config.json, normalisation in preprocessor_config.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8

WEIGHTS = ("model.safetensors", "pytorch_model.bin")
CONFIG, PREPROCESSOR = "config.json", "preprocessor_config.json"
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's red, green and blue (0 to 1), with which most networks were trained."""


@dataclass(frozen=True)
class Normalisation:
    """Values of a network's input: (grey level * scale - mean) / std of each channel.

    Attributes:
        scale: factor of grey levels 0 to 255.
        mean, std: (3,) of red, green and blue (or blue, green and red), after the scale.
        bgr: whether the channels are blue, green and red.
    """

    scale: float = 1 / 255
    mean: F32 = field(default_factory=lambda: np.array(MEAN, np.float32))
    std: F32 = field(default_factory=lambda: np.array(STD, np.float32))
    bgr: bool = False

    def __call__(self, rgb: U8) -> F32:
        """(H, W, 3) values of a photo (H, W, 3)."""
        levels = rgb[..., ::-1] if self.bgr else rgb
        return np.asarray((levels.astype(np.float32) * self.scale - self.mean) / self.std, np.float32)


def read_normalisation(path: Path) -> Normalisation:
    """The normalisation that a `preprocessor_config.json` states.

    Raises:
        InputError: the file can't be read, or a value is invalid.
    """
    given = read_json(path, "Copy it again from the network's author")
    bgr = bool(given.get("do_flip_channel_order", False))  # MobileViT, which isn't normalised either
    rescaled = given.get("do_rescale", True)
    (scale,) = numbers([given.get("rescale_factor", 1 / 255) if rescaled else 1], 1, path)
    if not given.get("do_normalize", not bgr):
        return Normalisation(float(scale), np.zeros(3, np.float32), np.ones(3, np.float32), bgr)
    std = numbers(given.get("image_std", STD), 3, path)
    return Normalisation(float(scale), numbers(given.get("image_mean", MEAN), 3, path, minimum=-np.inf), std, bgr)


def numbers(value: object, n: int, path: Path, minimum: float = 1e-6) -> F32:
    """(n,) float32 of a value for the normalisation of photos from a file.

    Raises:
        InputError: the value is not n finite numbers of at least `minimum`.
    """
    try:
        found = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        found = np.empty(0, np.float32)
    if found.shape != (n,) or not np.isfinite(found).all() or found.min() < minimum:
        raise InputError(
            path, f"invalid value {value!r} for the normalisation of photos", f"Change it to {n} valid numbers"
        )
    return found


def label_names(config: dict[str, Any], path: Path) -> tuple[str, ...]:
    """Label names by channel from the `id2label` of a config.

    Raises:
        InputError: not every channel from 0 on has a name.
    """
    try:
        labels = {int(key): str(name) for key, name in config["id2label"].items()}
    except (KeyError, AttributeError, ValueError):
        labels = {}
    if not labels or sorted(labels) != list(range(len(labels))):
        raise InputError(path, "id2label doesn't name every channel from 0 on", "Add the missing label names")
    return tuple(labels[i] for i in range(len(labels)))


def beside(path: Path, name: str) -> Path | None:
    """File of Hugging Face beside the weights at `path`, or beside their folder `onnx`; None if there is none."""
    folders = [path.parent, path.parent.parent] if path.parent.name == "onnx" else [path.parent]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def network_files(weights: Path) -> list[Path]:
    """Existing files that define a network: its weights, a file or a folder, and those that backends read beside it."""
    if weights.is_dir():
        own = [weights / name for name in WEIGHTS]
    else:
        own = [weights, weights.with_suffix(".labels.txt"), weights.with_name(f"{weights.name}.data")]
    config = [beside(own[0], name) for name in (CONFIG, PREPROCESSOR)]
    return [path for path in (*own, *config) if path and path.is_file()]


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        InputError: the file can't be read, or contains something else.
    """
    try:
        config = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(path, f"can't be read ({error})", remedy) from None
    if not isinstance(config, dict):
        raise InputError(path, "not a JSON object", remedy)
    return config
