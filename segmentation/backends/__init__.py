"""Segmentation networks behind one protocol: a file a backend, found by its name.

A backend's module has `missing(weights) -> str | None` (the packages it lacks to run those weights here) and
`load(weights, device) -> Network`.
"""

from __future__ import annotations

import importlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from scan2sim.pipeline.errors import InputError, SettingError
from scan2sim.pipeline.extras import unavailable
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
        channels: whether it takes those of `pipeline.channels`, too.
    """

    name: str
    labels: tuple[str, ...]
    sha256: str
    licence: str
    pixels_a_radian: float | None
    channels: bool = False


class Network(Protocol):
    """A network that is loaded."""

    facts: Facts

    def probabilities(self, seen: U8) -> F32:
        """(C, h, w) float32 that sum to 1 over the labels, for (H, W, 3) uint8; h, w may be a fraction of H, W.

        Args:
            seen: colours; for a network that takes `channels` (H, W, 7), with them, 0 where nothing is known.

        Raises:
            MemoryError: the photo doesn't fit on the device; smaller tiles may.
        """


def load(name: str, weights: Path | None, device: str = "auto") -> Network:
    """The network of a backend, with the user's weights or, for "street", the project's own.

    Raises:
        SettingError: the device isn't there.
        InputError: the weights are damaged, of another architecture, or unsafe to read.
        ScanError: as `check`.
    """
    network: Network = check(name, weights).load(weights, device)
    return network


def check(name: str, weights: Path | None) -> Any:
    """The module of a backend that can run here; nothing heavy is loaded.

    Raises:
        SettingError: there is no such backend, or it wants weights.
        UnavailableError: a package is missing.
        InputError: the weights aren't there.
    """
    if name not in NAMES:
        raise SettingError("label.network", f"there is no {name!r}", f"Choose one of: {', '.join(NAMES)}")
    backend = importlib.import_module(f"scan2sim.segmentation.backends.{name}")
    lacking = backend.missing(weights)
    if lacking:
        raise unavailable(f"label.network {name}", lacking)
    if weights is None and name != "street":
        raise SettingError("label.weights", f"{name!r} comes without weights", "Name yours: --set label.weights=PATH")
    if weights is not None and not weights.exists():
        raise InputError(weights, "is no file or folder", "Give one on this disk; nothing is downloaded")
    return backend


def torch_device(device: str) -> str:
    """A device of torch; "auto" stands for a GPU where there is one.

    Raises:
        SettingError: torch can't use it here.
    """
    if device == "auto" and shutil.which("nvidia-smi") is None:
        return "cpu"
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return str(torch.zeros(1, device=device).device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise SettingError("label.device", f"torch can't use {device!r} here ({reason})", "Say cpu, or auto") from None
