"""Segmentation networks behind one protocol: a file a backend, found by its name.

A backend's module has `available() -> str | None` (what to install, if it can't run here) and
`load(weights, device) -> Network`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.errors import SettingError
from scan2sim.pipeline.types import F32, U8

NAMES = ("street", "segformer", "onnx")


@dataclass(frozen=True)
class Facts:
    """What is known of a network.

    Attributes:
        name: of backend and weights.
        labels: names of what it tells, in order of its channels.
        sha256: of the weights' file.
        licence: of the weights, as far as the file tells.
        pixels_a_radian: angular resolution that photos should be resampled to; None: as they are.
    """

    name: str
    labels: tuple[str, ...]
    sha256: str
    licence: str
    pixels_a_radian: float | None


class Network(Protocol):
    """A network that is loaded."""

    facts: Facts

    def probabilities(self, rgb: U8) -> F32:
        """(C, h, w) float32 that sum to 1 over the labels, for (H, W, 3) uint8; h, w may be a fraction of H, W.

        Raises:
            MemoryError: the photo doesn't fit on the device; smaller tiles may.
        """


def load(name: str, weights: Path | None, device: str = "auto") -> Network:
    """The network of a backend, with the user's weights or, for "street", the project's own.

    Raises:
        SettingError: there is no such backend, it can't run here, or it wants weights.
        InputError: the weights are damaged, of another architecture, or unsafe to read.
    """
    if name not in NAMES:
        raise SettingError("label.network", f"there is no {name!r}", f"Choose one of: {', '.join(NAMES)}")
    backend = importlib.import_module(f"scan2sim.segmentation.backends.{name}")
    missing = backend.available()
    if missing:
        raise SettingError("label.network", f"{name!r} can't run here: {missing}", f"Install {missing}")
    network: Network = backend.load(weights, device)
    return network


def torch_device(device: str) -> str:
    """The device of torch that "auto" stands for here: a GPU where there is one."""
    if device != "auto":
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"
