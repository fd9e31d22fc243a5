"""Weights: tensors of the user's files, checked before they are used; no code that a file may hold is run.

Nothing is ever downloaded, and nothing of others is part of the project: who uses a network gives its file, and is
told by `Weights.describe` what it is and under which licence.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, SettingError

Shape = tuple[int, ...]

NEEDS = ("torch", "safetensors")
"""Packages that networks of SLAM need."""
SIGNS = {
    r"convPa\.weight": "SuperPoint",
    r"bin_score": "SuperGlue",
    r"log_assignment\.\d+\.matchability\.weight": "LightGlue",
    r"desc_head\.agg_weights": "ALIKED",
    r"keypoint_decoder\.conv_score_a\.weight": "SuperPoint as transformers writes it",
    r"keypoint_encoder\.encoder\.0\.linear\.weight": "SuperGlue as transformers writes it",
    r"match_assignment_layers\.0\.matchability\.weight": "LightGlue as transformers writes it",
    r"(matcher\.)?loftr_coarse\..*": "LoFTR",
    r"segformer\..*": "SegFormer",
}
"""What names of tensors tell of the network they are of."""


@dataclass(frozen=True)
class Model:
    """A network that a file may be of.

    Attributes:
        name: to tell people.
        shapes: of its tensors.
        licence: of its published weights.
        published: names of published files by their SHA-256.
        optional: pattern of names that may be there or not, and aren't used.
        renames: pattern and replacement of names in files to those in `shapes`.
    """

    name: str
    shapes: dict[str, Shape]
    licence: str
    published: dict[str, str] = field(default_factory=dict)
    optional: str = r".*\.num_batches_tracked"
    renames: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Weights:
    """Of a model: float32 `tensors` by name, on a device of torch."""

    path: Path
    model: Model
    device: str
    sha256: str
    tensors: dict[str, Any]

    def describe(self) -> str:
        """What is used: file, model, hash, licence."""
        known = self.model.published.get(self.sha256)
        origin = f"as published ({known})" if known else "not a file known to the project"
        return f"{self.path.name}: {self.model.name}, SHA-256 {self.sha256}, {origin}; licence: {self.model.licence}"


def torch_device(device: str) -> str:
    """The device of torch that "auto" stands for here: a GPU where there is one."""
    if device != "auto":
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def load(path: Path | None, models: Sequence[Model], *, hint: str, device: str = "auto") -> Weights:
    """Tensors of a safetensors file or one of `torch.save`.

    Args:
        path: the user's file.
        models: one of which it should be of.
        hint: which file to give.
        device: of torch, or "auto".

    Raises:
        SettingError: no file is given.
        InputError: it is missing, damaged, of another model, or holds more than tensors.
    """
    if path is None:
        raise SettingError("track.weights", f"{models[0].name} comes without weights", hint)
    if not path.is_file():
        raise InputError(path, "is no file", f"{hint}; nothing is downloaded")
    state = _tensors(path, hint)
    fits = [(_faults(state, model), model) for model in models]
    faults, model = min(fits, key=lambda fit: len(fit[0]))
    if faults:
        raise _wrong(path, state, models, faults, hint)
    renamed = _renamed(state, model)
    device = torch_device(device)
    tensors = {name: renamed[name].float().to(device) for name in model.shapes}
    bad = next((name for name, value in tensors.items() if not bool(value.isfinite().all())), None)
    if bad:
        raise InputError(path, f"holds numbers that aren't finite, in {bad}", "Copy or download it again")
    return Weights(path, model, device, hashlib.sha256(path.read_bytes()).hexdigest(), tensors)


def _renamed(state: dict[str, Any], model: Model) -> dict[str, Any]:
    out = {}
    for name, value in state.items():
        for pattern, replacement in model.renames:
            name = re.sub(pattern, replacement, name)
        out[name] = value
    return out


def _faults(state: dict[str, Any], model: Model) -> list[str]:
    """What speaks against a file's being of a model."""
    shapes = {name: tuple(value.shape) for name, value in _renamed(state, model).items()}
    faults = [f"{name} is missing" for name in model.shapes if name not in shapes]
    faults += [
        f"{name} is {_size(shapes[name])}, not {_size(shape)}"
        for name, shape in model.shapes.items()
        if name in shapes and shapes[name] != shape
    ]
    strays = [name for name in shapes if name not in model.shapes and not re.fullmatch(model.optional, name)]
    return faults + [f"{name} is unknown" for name in strays]


def _size(shape: Shape) -> str:
    return " x ".join(map(str, shape)) or "a number"


def _wrong(path: Path, state: dict[str, Any], models: Sequence[Model], faults: list[str], hint: str) -> InputError:
    """What was expected, and what was found."""
    expected = " or ".join(model.name for model in models)
    found = {kind for sign, kind in SIGNS.items() for name in state if re.fullmatch(sign, name)}
    if found and not any(model.name.startswith(kind) for model in models for kind in found):
        return InputError(path, f"holds weights of {' and '.join(sorted(found))}, expected {expected}", hint)
    some = ", ".join(list(state)[:3]) or "nothing"
    kind = f"weights of {' and '.join(sorted(found))} of another shape" if found else f"another network ({some} ...)"
    return InputError(path, f"holds {kind}, expected {expected}: {faults[0]}, {len(faults)} such faults", hint)


def _tensors(path: Path, hint: str) -> dict[str, Any]:
    """By name; code that a pickle may hold isn't run."""
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state = load_file(path)
        else:
            state = torch.load(path, "cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # damaged files raise a dozen kinds
        code = re.search(r"GLOBAL (\S+)", str(error))
        if code:
            cause = f"holds code or objects besides tensors; not run ({code[1]})"
            raise InputError(path, cause, "Ask who made it for a .safetensors file, which can't hold any") from None
        why = str(error).rpartition("WeightsUnpickler error:")[2].strip().split("\n")[0] or type(error).__name__
        raise InputError(path, f"is no whole file of tensors alone ({why})", f"Copy it again. {hint}") from None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError(path, "holds no tensors by name", "Save the network's `state_dict()` alone")
    return state
