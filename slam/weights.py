"""Network weights: loads tensors from files supplied by the user, after checking them; never executes code in a file.

Nothing is downloaded, and no third-party weights are part of the project. `Weights.describe` reports the model, hash
and licence of a file.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, SettingError

Shape = tuple[int, ...]

NEEDS = ("torch", "safetensors")
"""Packages that the networks need."""
NETWORK_SIGNATURES = {
    r"convPa\.weight|keypoint_decoder\.conv_score_a\.weight": "SuperPoint",
    r"keypoint_encoder\.encoder\.0\.linear\.weight": "SuperGlue",
    r"kenc\.encoder\.0\.weight": "SuperGlue as Magic Leap publishes it",
    r"(log_assignment|match_assignment_layers)\.\d+\.matchability\.weight": "LightGlue",
    r"desc_head\.agg_weights": "ALIKED",
    r"(matcher\.)?loftr_coarse\..*": "LoFTR",
    r"segformer\..*": "SegFormer",
}
"""Patterns of tensor names that identify a network."""
Renames = Sequence[tuple[str, str | Callable[[re.Match[str]], str]]]
"""Patterns and replacements that convert names of tensors, applied in order."""


@dataclass(frozen=True)
class Model:
    """Expected contents of a weights file.

    Attributes:
        name: name of the network, for messages.
        shapes: shapes of its tensors by name.
        licence: licence of its published weights.
        published: names of published files by their SHA-256.
        optional: pattern of tensor names that may occur and are ignored.
        convert: converts tensors as published to those in `shapes`, and leaves others as they are.
    """

    name: str
    shapes: dict[str, Shape]
    licence: str
    published: dict[str, str] = field(default_factory=dict)
    optional: str = r".*\.num_batches_tracked"
    convert: Callable[[dict[str, Any]], dict[str, Any]] = dict


@dataclass(frozen=True)
class Weights:
    """Weights of a model: float32 `tensors` by name, on a torch device, from a file or folder `path`."""

    path: Path
    model: Model
    device: str
    sha256: str
    tensors: dict[str, Any]

    def set_in(self, network: Any) -> Any:
        """Set the tensors in a torch module, without copying them, and prepare it for inference."""
        network.load_state_dict(self.tensors, strict=False, assign=True)
        return network.eval().requires_grad_(False).to(self.device)

    def describe(self) -> str:
        """Description for logs: file, model, hash, licence."""
        known = self.model.published.get(self.sha256)
        origin = f"as published ({known})" if known else "not a file known to the project"
        return f"{self.path.name}: {self.model.name}, SHA-256 {self.sha256}, {origin}; licence: {self.model.licence}"


def shapes_of(network: Any, optional: str = "") -> dict[str, Shape]:
    """Shapes of a torch module's tensors, without those whose names match a pattern."""
    state = network.state_dict()
    return {name: tuple(value.shape) for name, value in state.items() if not re.fullmatch(optional, name)}


def renamed(state: dict[str, Any], renames: Renames) -> dict[str, Any]:
    """Tensors by other names."""
    out = {}
    for name, value in state.items():
        for pattern, replacement in renames:
            name = re.sub(pattern, replacement, name)
        out[name] = value
    return out


def torch_device(device: str) -> str:
    """Resolve "auto" to "cuda" if a GPU is available, else "cpu"; other device names are returned unchanged."""
    if device != "auto":
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def load(path: Path | None, models: Sequence[Model], *, hint: str, device: str = "auto") -> Weights:
    """Load the tensors of a safetensors file, or of a file written by `torch.save`.

    Args:
        path: the user's file, or a folder with model.safetensors, as `save_pretrained` of `transformers` writes it.
        models: accepted models.
        hint: which file to supply, for error messages.
        device: torch device, or "auto".

    Raises:
        SettingError: no file is given.
        InputError: the file is missing, damaged, of another model, or contains more than tensors.
    """
    if path is None:
        raise SettingError("track.weights", f"{models[0].name} needs weights", hint)
    file = path / "model.safetensors" if path.is_dir() else path
    if not file.is_file():
        raise InputError(file, "file not found", f"{hint}; weights aren't downloaded")
    state = _tensors(file, hint)
    checks = [(_mismatches(state, model), model) for model in models]
    mismatches, model = min(checks, key=lambda check: len(check[0]))
    if mismatches:
        raise _wrong_model(file, state, models, mismatches, hint)
    converted = _converted(state, model)
    device = torch_device(device)
    tensors = {name: converted[name].float().to(device) for name in model.shapes}
    bad = next((name for name, value in tensors.items() if not bool(value.isfinite().all())), None)
    if bad:
        raise InputError(file, f"contains NaN or infinite values in {bad}", "Copy or download it again")
    return Weights(path, model, device, hashlib.sha256(file.read_bytes()).hexdigest(), tensors)


def _converted(state: dict[str, Any], model: Model) -> dict[str, Any]:
    try:
        return model.convert(state)
    except (RuntimeError, IndexError):  # tensors of other shapes
        return state


def _mismatches(state: dict[str, Any], model: Model) -> list[str]:
    """Differences between a file's tensors and those of a model."""
    shapes = {name: tuple(value.shape) for name, value in _converted(state, model).items()}
    mismatches = [f"{name} is missing" for name in model.shapes if name not in shapes]
    mismatches += [
        f"{name} is {_size(shapes[name])}, not {_size(shape)}"
        for name, shape in model.shapes.items()
        if name in shapes and shapes[name] != shape
    ]
    unknown = [name for name in shapes if name not in model.shapes and not re.fullmatch(model.optional, name)]
    return mismatches + [f"{name} is unknown" for name in unknown]


def _size(shape: Shape) -> str:
    return " x ".join(map(str, shape)) or "a number"


def _wrong_model(
    path: Path, state: dict[str, Any], models: Sequence[Model], mismatches: list[str], hint: str
) -> InputError:
    """Error that names the expected model, and the one found."""
    expected = " or ".join(model.name for model in models)
    found = {kind for sign, kind in NETWORK_SIGNATURES.items() for name in state if re.fullmatch(sign, name)}
    if found and not any(model.name.startswith(kind) for model in models for kind in found):
        return InputError(path, f"holds weights of {' and '.join(sorted(found))}, expected {expected}", hint)
    first = ", ".join(list(state)[:3]) or "nothing"
    kind = f"weights of {' and '.join(sorted(found))} of another shape" if found else f"another network ({first} ...)"
    count = f"{len(mismatches)} mismatches"
    return InputError(path, f"holds {kind}, expected {expected}: {mismatches[0]}, {count}", hint)


def _tensors(path: Path, hint: str) -> dict[str, Any]:
    """Tensors of a file by name; code in a pickle isn't executed."""
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state = load_file(path)
        else:
            state = torch.load(path, "cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # damaged files raise many types of errors
        code = re.search(r"GLOBAL (\S+)", str(error))
        if code:
            cause = f"holds code or objects besides tensors; not executed ({code[1]})"
            raise InputError(path, cause, "Ask its author for a .safetensors file, which can't contain code") from None
        why = str(error).rpartition("WeightsUnpickler error:")[2].strip().split("\n")[0] or type(error).__name__
        raise InputError(path, f"is damaged, or no file of tensors ({why})", f"Copy it again. {hint}") from None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError(path, "holds no named tensors", "Save only the network's `state_dict()`")
    return state
