"""Checkpoints: the state of an object tree in one .npz file of arrays and JSON; reading it never executes code.

A class names the attributes that are saved (`STATE`), and the attributes that are objects with a `STATE` of their own
(`PARTS`). A checkpoint is loaded into a newly constructed object of the same camera, parameters and weights.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


class InvalidCheckpoint(ValueError):
    """A checkpoint file is damaged, or holds the state of another class."""


def save(path: Path, root: Any, values: Sequence[type]) -> None:
    """Write the state of `root` atomically: an interrupted write leaves no partial file at `path`.

    Args:
        values: dataclasses and named tuples that may occur in the state, besides arrays and JSON types.

    Raises:
        TypeError: the state contains any other type.
        OSError: the file can't be written.
    """
    data = bytearray()
    tree = json.dumps(_state(root, values, data))
    path.parent.mkdir(parents=True, exist_ok=True)
    work = path.with_suffix(".part")
    with open(work, "wb") as file:
        np.savez(file, tree=np.frombuffer(tree.encode(), np.uint8), data=np.frombuffer(data, np.uint8))
    work.replace(path)


def load(path: Path, root: Any, values: Sequence[type]) -> None:
    """Restore the state of `root` from a file.

    Raises:
        InvalidCheckpoint: the file is damaged, or of another class; discard `root` then, it may be partly restored.
        OSError: the file can't be read.
    """
    known = {kind.__name__: kind for kind in values}
    try:
        with np.load(path, allow_pickle=False) as file:
            tree, data = json.loads(file["tree"].tobytes()), file["data"].tobytes()
        _restore(root, tree, known, data)
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, RecursionError, zipfile.BadZipFile) as error:
        raise InvalidCheckpoint(f"{type(error).__name__}: {error}") from error


def _state(part: Any, values: Sequence[type], data: bytearray) -> dict[str, Any]:
    tree = {name: _encoded(getattr(part, name), values, data) for name in part.STATE}
    children = {name: getattr(part, name) for name in getattr(part, "PARTS", ())}
    return tree | {name: _state(value, values, data) for name, value in children.items() if hasattr(value, "STATE")}


def _restore(part: Any, tree: dict[str, Any], known: dict[str, type], data: bytes) -> None:
    for name in part.STATE:
        setattr(part, name, _decoded(tree[name], known, data))
    for name in getattr(part, "PARTS", ()):
        if hasattr(getattr(part, name), "STATE"):
            _restore(getattr(part, name), tree[name], known, data)


def _encoded(value: Any, values: Sequence[type], data: bytearray) -> Any:
    """A value as JSON; the contents of arrays are appended to `data`."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        data += value.tobytes()
        return {"array": value.dtype.str, "shape": value.shape, "end": len(data)}
    if isinstance(value, np.random.Generator):
        return {"random": value.bit_generator.state}
    if isinstance(value, dict):
        return {"dict": [[key, _encoded(one, values, data)] for key, one in value.items()]}
    if type(value) in values:
        names = getattr(value, "_fields", None) or value.__dataclass_fields__
        return {"kind": type(value).__name__} | {name: _encoded(getattr(value, name), values, data) for name in names}
    if type(value) in (list, tuple):
        tree = [_encoded(one, values, data) for one in value]
        return tree if isinstance(value, list) else {"tuple": tree}
    raise TypeError(f"{type(value).__name__} can't be saved in a checkpoint")


def _decoded(tree: Any, known: dict[str, type], data: bytes) -> Any:
    """Inverse of `_encoded`."""
    if isinstance(tree, list):
        return [_decoded(one, known, data) for one in tree]
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        dtype, shape = np.dtype(tree["array"]), tree["shape"]
        size = dtype.itemsize * int(np.prod(shape))
        return np.frombuffer(data[tree["end"] - size : tree["end"]], dtype).reshape(shape).copy()
    if "random" in tree:
        generator = np.random.default_rng()
        generator.bit_generator.state = tree["random"]
        return generator
    if "dict" in tree:
        return {key: _decoded(one, known, data) for key, one in tree["dict"]}
    if "tuple" in tree:
        return tuple(_decoded(one, known, data) for one in tree["tuple"])
    return known[tree["kind"]](**{name: _decoded(one, known, data) for name, one in tree.items() if name != "kind"})
