"""Files of models: the user's own, or what comes along; tensors alone, never a pickle's code."""

from __future__ import annotations

import hashlib
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.toolboxes.settings import ToolboxParams

FOLDER = Path(__file__).parent / "weights"
"""Of models that come along."""
SAFE = (".onnx", ".safetensors")
"""Ends of files that can't hold code."""
IMAGENET = FOLDER / "imagenet.labels.txt"
"""Names of ImageNet's thousand classes (of WordNet's synsets), in the usual order."""


def chosen(params: ToolboxParams, own: Path | None) -> Path:
    """The user's file or, without one, what comes along.

    Raises:
        SettingError: nothing comes along.
        InputError: the file isn't there, may hold code, or isn't the one that was meant.
    """
    path = params.weights or own
    if path is None:
        raise SettingError("--weights", "is missing: this model comes without any", "Give a file on this disk")
    if params.weights is not None:
        _check_kind(path)
    if params.sha256 is not None and (found := sha256(path)) != params.sha256:
        raise InputError(path, f"has the SHA-256 {found}, not {params.sha256}", "Copy it again, from where you trust")
    return path


def sha256(path: Path) -> str:
    """Of a file.

    Raises:
        InputError: it can't be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a file on this disk") from None


def imagenet() -> tuple[str, ...]:
    """Names of ImageNet's classes."""
    return tuple(IMAGENET.read_text("utf-8").split("\n")[:-1])


def _check_kind(path: Path) -> None:
    if not path.exists():
        raise InputError(path, "is not there", "Give a file on this disk; nothing is downloaded")
    if path.is_file() and path.suffix not in SAFE:
        raise InputError(path, "may hold code, as pickled weights do", f"Export it: {' or '.join(SAFE)}")
