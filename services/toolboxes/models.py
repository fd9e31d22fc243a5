"""Models: their description, and their weight files.

Weight files are the user's, or those included here; only formats that can't contain code, no pickles.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.toolboxes.settings import ToolboxParams

FOLDER = Path(__file__).parent / "weights"
"""Folder of the included weights."""
SAFE_SUFFIXES = (".onnx", ".safetensors")
"""File formats that can't contain code."""
IMAGENET_LABELS = FOLDER / "imagenet.labels.txt"
"""Names of ImageNet's thousand classes (WordNet synsets), in the usual order."""


def weights_file(params: ToolboxParams, included: Path | None) -> Path:
    """Path of the weights: the user's file or, without one, the included file.

    Raises:
        SettingError: there are no included weights.
        InputError: the file is missing, may contain code, or has another SHA-256 than expected.
    """
    path = params.weights or included
    if path is None:
        raise SettingError("--weights", "is missing: no weights are included for this model", "Give a local file")
    if params.weights is not None:
        _check_format(path)
    if params.sha256 is not None and (found := sha256(path)) != params.sha256:
        cause = f"has SHA-256 {found} instead of {params.sha256}"
        raise InputError(path, cause, "Copy it again from a trusted source")
    return path


def sha256(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        InputError: it can't be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a readable local file") from None


def imagenet() -> tuple[str, ...]:
    """Names of ImageNet's classes."""
    return tuple(IMAGENET_LABELS.read_text("utf-8").split("\n")[:-1])


def _check_format(path: Path) -> None:
    if not path.exists():
        raise InputError(path, "file not found", "Give a local file; weights are never downloaded")
    if path.is_file() and path.suffix not in SAFE_SUFFIXES:
        raise InputError(path, "may contain code, like pickled weights", f"Export it as {' or '.join(SAFE_SUFFIXES)}")


@dataclass(frozen=True)
class ModelInfo:
    """Description of a model.

    Attributes:
        name: name of its architecture or file.
        labels: names of its classes.
        sha256: SHA-256 of the weights file.
        licence: licence of the weights, as far as the file or its package states it.
    """

    name: str
    labels: tuple[str, ...]
    sha256: str
    licence: str
