"""Networks in ONNX files: opened with onnxruntime, and what their files say of themselves."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, SettingError

FLOATS = {"tensor(float)": "float32", "tensor(float16)": "float16"}
"""Types of inputs that images are converted to, as numpy calls them."""
CUDA = "CUDAExecutionProvider"


def opened(path: Path, device: str, setting: str) -> Any:
    """An `onnxruntime.InferenceSession` of a file, on a device ("auto", "cpu", "cuda", "cuda:1").

    Args:
        setting: that named the device, for the message.

    Raises:
        SettingError: onnxruntime can't use the device.
        InputError: the file is missing or damaged.
        MemoryError: it doesn't fit.
    """
    import onnxruntime

    if not path.is_file():
        raise InputError(path, "is no file", "Give an ONNX file on this disk; nothing is downloaded")
    number = {"device_id": device.partition(":")[2] or "0"}
    providers = [] if device == "cpu" or CUDA not in onnxruntime.get_available_providers() else [(CUDA, number)]
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its errors are raised; no need to print them as well
    options.intra_op_num_threads = _threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # several nodes share the cores
    try:
        session = onnxruntime.InferenceSession(path, options, [*providers, "CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no kind in common
        remedy = "Copy or export it again, with its .data if it has one"
        raise failure(error, path, "can't be loaded", remedy) from None
    if device.startswith("cuda") and CUDA not in session.get_providers():
        raise SettingError(setting, f"onnxruntime can't use {device!r} here", "Install onnxruntime-gpu, or set cpu")
    return session


def failure(error: Exception, path: Path, cause: str, remedy: str) -> Exception:
    """What to raise for an error of onnxruntime's: MemoryError where it lacks memory, else an InputError."""
    why = str(error).strip().split("\n")[0]
    full = any(
        words in str(error).lower() for words in ("out of memory", "allocate memory", "bad_alloc", "alloc_failed")
    )
    return MemoryError(why) if full else InputError(path, f"{cause} ({why})", remedy)


def digest(path: Path) -> str:
    """SHA-256 of a file, and of the `.data` beside it where exporters put large weights."""
    together = hashlib.sha256(path.read_bytes())
    beside = path.with_name(path.name + ".data")
    if beside.is_file():
        together.update(beside.read_bytes())
    return together.hexdigest()


def value(text: str | None, other: object) -> Any:
    """A value of the metadata, as it stands if it is no JSON; `other` where nothing is."""
    try:
        return other if text is None else json.loads(text)
    except ValueError:
        return text


def labels(path: Path, metadata: dict[str, str]) -> tuple[str, ...]:
    """Names of a network's classes, by its metadata "labels", or by `<name>.labels.txt` beside it, one a line.

    Raises:
        InputError: neither names any.
    """
    beside = path.with_suffix(".labels.txt")
    remedy = f'Name them in order of the channels: metadata "labels" as a JSON list, or {beside.name}, one a line'
    try:
        names = value(metadata.get("labels"), None) or [
            line.strip() for line in beside.read_text("utf-8-sig").split("\n")
        ]
    except FileNotFoundError:
        raise InputError(path, "doesn't name its labels", remedy) from None
    except (OSError, ValueError) as error:
        raise InputError(beside, f"can't be read ({error})", remedy) from None
    if not isinstance(names, list) or not any(names) or not all(isinstance(name, str) for name in names):
        raise InputError(path, "has labels that are no list of names", remedy)
    return tuple(name for name in names if name)


def _threads() -> int:
    """As many as OpenMP's libraries take; onnxruntime itself doesn't ask."""
    count = os.environ.get("OMP_NUM_THREADS", "")
    if count.isdecimal() and int(count):
        return int(count)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
