"""Segmentation networks behind one protocol: one module per backend, found by name (`pipeline.core.plugins`)."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F32, U8


@dataclass(frozen=True)
class NetworkInfo:
    """Description of a network.

    Attributes:
        name: name of backend and weights.
        labels: names of its classes, in order of its output channels.
        sha256: checksum of the weights' file.
        licence: licence of the weights, as stated in the file.
        pixels_per_radian: angular resolution to which photos should be resampled; None: their own.
        channels: whether it takes `segmentation.lidar_channels`.
        size: height and width of its input, if they are fixed.
        assumed: what was assumed about its input, as nothing states it; empty: nothing.
    """

    name: str
    labels: tuple[str, ...]
    sha256: str
    licence: str
    pixels_per_radian: float | None
    channels: bool = False
    size: tuple[int, int] | None = None
    assumed: str = ""


class Network(Protocol):
    """A loaded network."""

    info: NetworkInfo

    def probabilities(self, seen: U8) -> F32:
        """(C, h, w) float32 probabilities of the labels, which sum to 1 or are all 0; h, w may be a fraction of H, W.

        Args:
            seen: (H, W, 3) uint8 colours; for a network with `channels` (H, W, 7), with them, 0 where unknown.

        Raises:
            MemoryError: the photo doesn't fit on the device; smaller tiles may.
        """


class Backend(Protocol):
    """Functions of a backend's module."""

    def check(self, weights: Path | None) -> None:
        """Check that the backend can run these weights on this machine, without loading anything large.

        Raises:
            ScanError: as raised by `backends.check`.
        """

    def load(self, weights: Path | None, device: str) -> Network:
        """The network with these weights, which were checked before."""


def load(name: str, weights: Path | None, device: str = "auto") -> Network:
    """The network of a backend, with your weights or, for "street", the project's own.

    Raises:
        SettingError: the device is not available.
        InputError: the weights are damaged, of another architecture, or unsafe to read.
        ScanError: as raised by `check`.
    """
    return check(name, weights).load(weights, device)


def check(name: str, weights: Path | None) -> Backend:
    """The module of a backend that can run on this machine; nothing large is loaded.

    Raises:
        SettingError: the backend is unknown, or needs weights.
        UnavailableError: a package is missing.
        InputError: the weights don't exist.
    """
    backend: Backend = plugins.find(__name__, name, "label.network")
    backend.check(weights)
    return backend


def require_weights(name: str, weights: Path | None) -> Path:
    """The user's weights, for a backend without its own.

    Raises:
        SettingError: no weights are set.
        InputError: they don't exist.
    """
    if weights is None:
        raise SettingError(
            "label.weights", f"{name!r} comes without weights", "Pass your weights: --set label.weights=PATH"
        )
    if not weights.exists():
        raise InputError(weights, "file or folder not found", "Pass a local path; nothing is downloaded")
    return weights


def torch_device(device: str) -> str:
    """A torch device; for "auto" a GPU if there is one, else "cpu".

    Raises:
        SettingError: torch can't use the device on this machine.
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
        raise SettingError("label.device", f"torch can't use {device!r} here ({reason})", "Set cpu or auto") from None
