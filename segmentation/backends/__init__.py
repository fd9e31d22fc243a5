"""Segmentation networks behind one protocol: a file a backend (`pipeline.core.plugins`), found by its name."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F32, U8


@dataclass(frozen=True)
class Facts:
    """What is known of a network.

    Attributes:
        name: of backend and weights.
        labels: names of its classes, in order of its channels.
        sha256: of the weights' file.
        licence: of the weights, as far as the file tells.
        pixels_a_radian: angular resolution that photos should be resampled to; None: as they are.
        channels: whether it takes those of `segmentation.lidar_channels`, too.
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


class Backend(Protocol):
    """What a backend's module has."""

    def check(self, weights: Path | None) -> None:
        """Refuse weights that it can't run here; nothing heavy is loaded.

        Raises:
            ScanError: as `check`.
        """

    def load(self, weights: Path | None, device: str) -> Network:
        """The network with these weights, which were checked."""


def load(name: str, weights: Path | None, device: str = "auto") -> Network:
    """The network of a backend, with the user's weights or, for "street", the project's own.

    Raises:
        SettingError: the device isn't there.
        InputError: the weights are damaged, of another architecture, or unsafe to read.
        ScanError: as `check`.
    """
    return check(name, weights).load(weights, device)


def check(name: str, weights: Path | None) -> Backend:
    """The module of a backend that can run here; nothing heavy is loaded.

    Raises:
        SettingError: there is no such backend, or it wants weights.
        UnavailableError: a package is missing.
        InputError: the weights aren't there.
    """
    backend: Backend = plugins.find(__name__, name, "label.network")
    backend.check(weights)
    return backend


def given(name: str, weights: Path | None) -> Path:
    """Weights of the user's, for a backend that comes without.

    Raises:
        SettingError: there are none.
        InputError: they aren't there.
    """
    if weights is None:
        raise SettingError("label.weights", f"{name!r} comes without weights", "Name yours: --set label.weights=PATH")
    if not weights.exists():
        raise InputError(weights, "is no file or folder", "Give one on this disk; nothing is downloaded")
    return weights


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
