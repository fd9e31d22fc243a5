"""TOML files that users write, read into a model: what is wrong is named by its field."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

M = TypeVar("M", bound=BaseModel)
LARGEST = 64_000_000
"""Bytes of a file: a hundred thousand photos have room."""


def read(path: Path, model: type[M], *, absent: tuple[str, str], fields: str) -> M:
    """Read and check a file.

    Args:
        absent: cause and remedy where there is no such file.
        fields: which document lists the fields, as a remedy.

    Raises:
        InputError: it is missing, not TOML, or says something that the model refuses.
    """
    try:
        return model.model_validate(table(path, absent))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `{where}`: {first['msg']}", fields) from None


def table(path: Path, absent: tuple[str, str] = ("is missing", file_checks.PUT_THERE)) -> dict[str, Any]:
    """What a file says, unchecked; a byte order mark, as Windows' editors write it, is no part of it.

    Raises:
        InputError: it is missing (`absent` are cause and remedy then), no file, or not TOML.
    """
    cause = file_checks.problem(path)
    if cause is not None:
        raise InputError(path, *(absent if cause == "is missing" else (cause, absent[1])))
    if path.stat().st_size > LARGEST:
        raise InputError(path, f"is of {path.stat().st_size:,} bytes, more than {LARGEST:,}", "Name another file")
    try:
        return parse(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise InputError(path, f"is not valid TOML ({error})", "Mend the line that the message names") from None


def parse(text: str) -> dict[str, Any]:
    """What TOML text says.

    Raises:
        ValueError: it isn't TOML, nested too deep, or has a number of thousands of digits.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("arrays or tables in one another, too deep to read") from None
