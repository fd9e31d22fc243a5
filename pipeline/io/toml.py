"""TOML files written by users, read into a pydantic model; errors name the field."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

M = TypeVar("M", bound=BaseModel)
MAX_BYTES = 64_000_000
"""Maximum file size; enough for a tile of a hundred thousand photos."""


def read(path: Path, model: type[M], *, absent: tuple[str, str], fields: str) -> M:
    """Read and validate a file.

    Args:
        path: TOML file.
        model: its schema.
        absent: cause and remedy of the error if the file doesn't exist.
        fields: the document that lists the fields, as remedy of a validation error.

    Raises:
        InputError: it doesn't exist, is not TOML, or doesn't fit the model.
    """
    try:
        return model.model_validate(table(path, absent))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `{where}`: {first['msg']}", fields) from None


def table(path: Path, absent: tuple[str, str] = (file_checks.NOT_FOUND, file_checks.CHECK_PATH)) -> dict[str, Any]:
    """Content of a file, not validated; a byte order mark (written by Windows editors) is ignored.

    Raises:
        InputError: it doesn't exist (with `absent` as cause and remedy), is not a file, or not TOML.
    """
    cause = file_checks.problem(path)
    if cause is not None:
        raise InputError(path, *(absent if cause == file_checks.NOT_FOUND else (cause, absent[1])))
    if path.stat().st_size > MAX_BYTES:
        cause = f"has {path.stat().st_size:,} bytes, more than {MAX_BYTES:,}"
        raise InputError(path, cause, "Give another file")
    try:
        return parse(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise InputError(path, f"is not valid TOML ({error})", "Fix the line that the message names") from None


def parse(text: str) -> dict[str, Any]:
    """Parse TOML text.

    Raises:
        ValueError: it isn't TOML, is nested too deeply, or has a number of thousands of digits.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("arrays or tables are nested too deeply") from None
