"""TOML files that users write, read into a model: what is wrong is named by its field."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from scan2sim.pipeline.errors import InputError

M = TypeVar("M", bound=BaseModel)


def read(path: Path, model: type[M], *, absent: tuple[str, str], fields: str) -> M:
    """Read and check a file.

    Args:
        absent: cause and remedy where there is no such file.
        fields: which document lists the fields, as a remedy.

    Raises:
        InputError: it is missing, not TOML, or says something that the model refuses.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(path, *absent) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not valid TOML ({error})", "Mend the line that the message names") from None
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `{where}`: {first['msg']}", fields) from None
