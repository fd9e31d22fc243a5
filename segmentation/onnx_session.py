"""Networks in ONNX files: inference sessions of onnxruntime, and the metadata of the files."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.cores import available_cores
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.segmentation.huggingface import CONFIG, beside, label_names, read_json
from scan2sim.segmentation.labels import read_names

FLOATS = {"tensor(float)": "float32", "tensor(float16)": "float16"}
"""NumPy type by ONNX type of the supported inputs."""
CUDA = "CUDAExecutionProvider"


def open_session(path: Path, device: str, setting: str) -> Any:
    """An `onnxruntime.InferenceSession` of a file on a device ("auto", "cpu", "cuda", "cuda:1").

    Args:
        path: ONNX file.
        device: device to use.
        setting: name of the setting of the device, for the error message.

    Raises:
        SettingError: onnxruntime can't use the device.
        InputError: the file is missing or damaged.
        MemoryError: the network doesn't fit into memory.
    """
    import onnxruntime

    if not path.is_file():
        raise InputError(path, "file not found", "Pass the path of a local ONNX file; nothing is downloaded")
    number = {"device_id": device.partition(":")[2] or "0"}
    providers = [] if device == "cpu" or CUDA not in onnxruntime.get_available_providers() else [(CUDA, number)]
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised as exceptions, so they need not be logged
    options.intra_op_num_threads = _threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # several tasks share the cores
    try:
        session = onnxruntime.InferenceSession(path, options, [*providers, "CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base class
        remedy = "Copy or export it again, with its .data file if it has one"
        if "opset" in str(error).lower() or "IR version" in str(error):
            remedy = (
                f"Update onnxruntime ({onnxruntime.__version__} here), or export it with an older opset, such as 17"
            )
        raise session_error(error, path, "can't be loaded", remedy) from None
    if device.startswith("cuda") and CUDA not in session.get_providers():
        raise SettingError(setting, f"onnxruntime can't use {device!r} here", "Install onnxruntime-gpu, or set cpu")
    return session


def session_error(error: Exception, path: Path, cause: str, remedy: str) -> Exception:
    """Exception to raise for an error of onnxruntime: MemoryError if memory is exhausted, else InputError."""
    why = str(error).strip().split("\n")[0]
    out_of_memory = any(
        words in str(error).lower() for words in ("out of memory", "allocate memory", "bad_alloc", "alloc_failed")
    )
    return MemoryError(why) if out_of_memory else InputError(path, f"{cause} ({why})", remedy)


def digest(path: Path) -> str:
    """SHA-256 of an ONNX file, including its `.data` file for large weights if there is one."""
    checksum = hashlib.sha256(path.read_bytes())
    data_file = path.with_name(path.name + ".data")
    if data_file.is_file():
        checksum.update(data_file.read_bytes())
    return checksum.hexdigest()


def metadata_value(text: str | None, default: object) -> Any:
    """Value of a metadata entry, parsed as JSON if possible; `default` if the entry is missing."""
    try:
        return default if text is None else json.loads(text)
    except ValueError:
        return text


def config_labels(path: Path) -> tuple[str, ...] | None:
    """Names of a network's classes in Hugging Face's `config.json` beside its file; None if it has none.

    Raises:
        InputError: they are invalid.
    """
    file = beside(path, CONFIG)
    config = read_json(file, "Copy it again from the network's author") if file else {}
    return label_names(config, file) if file and "id2label" in config else None


def read_labels(path: Path, metadata: dict[str, str]) -> tuple[str, ...]:
    """Names of a network's classes: metadata "labels", else `<name>.labels.txt`, one per line, else `config_labels`.

    Raises:
        InputError: the labels are missing or invalid.
    """
    label_file = path.with_suffix(".labels.txt")
    remedy = f'Name them in order of the channels: metadata "labels" as a JSON list, or {label_file.name}, one per line'
    names = metadata_value(metadata.get("labels"), None)
    if not names and label_file.is_file():
        return tuple(read_names(label_file))
    names = names or config_labels(path)
    if names is None:
        raise InputError(path, "no labels found for the network's classes", remedy)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) and name for name in names):
        raise InputError(path, "labels are not a list of names", remedy)
    return tuple(names)


def _threads() -> int:
    """Number of threads according to OMP_NUM_THREADS, which onnxruntime doesn't read, else of available cores."""
    count = os.environ.get("OMP_NUM_THREADS", "")
    if count.isdecimal() and int(count):
        return int(count)
    return available_cores()
