"""Reader of pickled pandas tables of numbers (`DataFrame.to_pickle`, .pkl and .pkl.gz), without pandas.

Unpickling runs whatever functions a file names. Here only those that tables of numbers need are known, and none of
them is the original: stand-ins gather the arguments, from which the columns are read. Any other name is an error.
"""

from __future__ import annotations

import gzip
import io
import pickle
import pickletools
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

MAX_BYTES = 1_000_000_000
"""Largest size of an unpacked table: a compressed file of a few MB could fill the memory."""
GZIP = b"\x1f\x8b"
REMEDY = "Give the file as it was published"


def read_columns(path: Path, names: Sequence[str]) -> dict[str, npt.NDArray[np.float64]]:
    """Columns (N,) of a table by name.

    Raises:
        InputError: it doesn't exist, is damaged, contains other things than a table of numbers, or misses a column.
    """
    raw = _content(path)
    try:
        for code, argument, _ in pickletools.genops(raw):  # checks lengths; a large memo index would fill the memory
            if code.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > len(raw):
                raise ValueError("memo index out of range")
        frame = _Unpickler(io.BytesIO(raw)).load()
        columns = frame.columns() if isinstance(frame, _DataFrame) else None
    except _UnknownName as error:
        cause = f"names {error}, which a table of numbers doesn't need, so it is not unpickled"
        raise InputError(path, cause, REMEDY) from None
    except Exception as error:  # a damaged pickle raises anything
        raise InputError(path, f"is not a pickled table of numbers ({error})", REMEDY) from None
    if columns is None:
        raise InputError(path, "does not contain a pandas DataFrame", REMEDY)
    missing = [name for name in names if name not in columns]
    if missing:
        cause = f"has no column {', '.join(missing)}; its columns are {', '.join(columns)}"
        raise InputError(path, cause, REMEDY)
    return {name: columns[name] for name in names}


def _content(path: Path) -> bytes:
    """The pickle, unpacked if it is compressed."""
    file_checks.check(path)
    try:
        with path.open("rb") as file:
            packed = file.read(2) == GZIP
        with gzip.open(path) if packed else path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(path, f"is damaged ({error})", "Unpack or download it again") from None
    if len(raw) > MAX_BYTES:
        raise InputError(path, f"unpacks to more than {MAX_BYTES:,} bytes", REMEDY)
    return raw


class _UnknownName(Exception):
    """A function or class that isn't needed for a table of numbers."""


class _Dtype:
    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "<"

    def __setstate__(self, state: Sequence[Any]) -> None:
        self.order = ">" if state[1] == ">" else "<"


class _Array:
    """Arguments of a NumPy array: shape, type, Fortran order, and bytes (or a list of objects)."""

    def __setstate__(self, state: Sequence[Any]) -> None:
        _, self.shape, self.dtype, self.fortran, self.data = state

    def values(self) -> npt.NDArray[Any]:
        if not re.fullmatch(r"[fiub][1248]", self.dtype.code):
            raise ValueError(f"a column has the type {self.dtype.code!r}")
        flat = np.frombuffer(self.data, np.dtype(self.dtype.order + self.dtype.code))
        return flat.reshape(self.shape, order="F" if self.fortran else "C")


def _array_of_buffer(data: bytes, dtype: _Dtype, shape: Sequence[int], order: str) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, dtype, order == "F", data))
    return array


def _empty_array(*_: object) -> _Array:
    return _Array()


def _encoded(text: str, _: str = "") -> bytes:
    return text.encode("latin-1")  # how protocol 2 stores bytes


class _Index:
    """Labels of an axis: `data`, an array of objects, for the names of columns."""

    def __init__(self, _: object, about: dict[str, Any]) -> None:
        self.about = about

    def names(self) -> list[str]:
        data = self.about["data"]
        return [str(name) for name in (data.data if isinstance(data, _Array) else data)]


class _Blocks:
    """Columns of equal type, two-dimensional: `values` (columns, rows), and their positions in the table."""

    def __init__(self, blocks: Sequence[Any] = (), axes: Sequence[Any] = ()) -> None:
        self.blocks, self.axes = blocks, axes

    def __setstate__(self, state: Sequence[Any]) -> None:  # pandas up to 1.2
        self.axes = state[3]["0.14.1"]["axes"]
        self.blocks = [(block["values"], block["mgr_locs"]) for block in state[3]["0.14.1"]["blocks"]]


def _block(values: _Array, positions: Any, *_: object) -> tuple[_Array, Any]:
    return values, positions


class _DataFrame:
    def __setstate__(self, state: dict[str, Any]) -> None:
        self.manager: _Blocks = state["_mgr" if "_mgr" in state else "_data"]

    def columns(self) -> dict[str, npt.NDArray[np.float64]]:
        """Columns (N,) by name."""
        names, found = self.manager.axes[0].names(), dict[str, npt.NDArray[np.float64]]()
        for values, positions in self.manager.blocks:
            if isinstance(positions, slice):
                positions = range(len(names))[positions]
            elif isinstance(positions, _Array):
                positions = positions.values().tolist()
            for position, column in zip(positions, values.values(), strict=True):
                found[names[position]] = column.astype(np.float64)
        if len({column.shape for column in found.values()}) > 1 or any(c.ndim != 1 for c in found.values()):
            raise ValueError("its columns differ in length")
        return {name: found[name] for name in names if name in found}


KNOWN: dict[str, dict[str, Any]] = {
    "pandas": {
        "DataFrame": _DataFrame, "BlockManager": _Blocks, "_unpickle_block": _block, "_new_Index": _Index,
        **dict.fromkeys(("Index", "RangeIndex", "Int64Index", "UInt64Index"), _Index),
    },
    "numpy": {"_reconstruct": _empty_array, "ndarray": _Array, "dtype": _Dtype, "_frombuffer": _array_of_buffer},
    "builtins": {"slice": slice},
    "__builtin__": {"slice": slice},
    "_codecs": {"encode": _encoded},
}  # fmt: skip
"""Stand-ins by package and name; modules of both packages were renamed more than once."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        known = KNOWN.get(module.split(".")[0], {})
        if name not in known:
            raise _UnknownName(f"{module}.{name}")
        return known[name]
