"""Ranges of parameters: the types that several share, and the sentence that describes a range.

They are generous: what is outside would be a slip of the pen, or take more memory or time than any machine has. What
takes memory by the data as well (texels of a surface, pixels of a map) is estimated and refused by its step.
"""

from __future__ import annotations

import types
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import AfterValidator, Field
from pydantic.fields import FieldInfo

Voxel = Annotated[float, Field(ge=0.005, le=100)]
"""Metres; finer than any scanner's noise there is nothing."""
Texel = Annotated[float, Field(ge=0.0005, le=10)]
"""Metres."""
Reach = Annotated[float, Field(ge=0.001, le=10_000)]
"""Metres up to which something is looked for, or taken for the same."""
Depth = Annotated[float, Field(ge=0, le=10)]
"""Metres that something may lie behind something else."""
Cosine = Annotated[float, Field(ge=0, le=0.99)]
Share = Annotated[float, Field(ge=0, le=1)]
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
"""Metres (or feet) in a CRS: two and a half times around the earth."""
Place = tuple[Coordinate, Coordinate]
Metres = Annotated[float, Field(ge=0, le=10_000)]
Length = Annotated[float, Field(ge=1, le=100_000)]
Stretch = Annotated[float, Field(ge=1, le=10_000)]
Buffer = Annotated[float, Field(ge=0, le=1000)]
Range = Annotated[float, Field(ge=0.1, le=10_000)]
Pixels = Annotated[float, Field(ge=-1_000_000, le=1_000_000)]
Focal = Annotated[float, Field(ge=1, le=1_000_000)]
"""Pixels."""
Rate = Annotated[float, Field(ge=0.01, le=1000)]
"""Frames a second."""
Shift = Annotated[float, Field(ge=-1e10, le=1e10)]
"""Seconds between two clocks, of which one may count from 1970."""
Seconds = Annotated[float, Field(ge=0.001, le=604_800)]
"""Up to a week."""
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
"""Of random numbers."""
Stops = Annotated[float, Field(ge=0.001, le=20)]
"""Of exposure, EV."""
Device = Annotated[
    str,
    Field(
        pattern=r"^(auto|numba|(cpu|cuda|mps|xpu)(:[0-9]{1,3})?)$",
        json_schema_extra={"range": "auto, numba, cpu, cuda, mps or xpu; cuda:1 for the second"},
    ),
]
"""What computes: "numba" in the step `texture` alone, the others as torch or onnxruntime call them."""
NAME = r"^[A-Za-z0-9_]{1,100}$"
"""What tiles and surveys may be called: names become folders, files and names in SDF."""
Name = Annotated[str, Field(pattern=NAME)]


def _no_nul(text: Any) -> Any:
    if "\0" in str(text) or len(str(text)) > 4096:
        raise ValueError("no path")
    return text


FileName = Annotated[str, AfterValidator(_no_nul)]
"""Of a file; "" where there is none."""
File = Annotated[Path, AfterValidator(_no_nul)]


def described(field: FieldInfo) -> str:
    """What a parameter may be: "0.005 to 100"."""
    extra = field.json_schema_extra
    if isinstance(extra, dict) and "range" in extra:
        return str(extra["range"])
    return _described(field.annotation, field.metadata)


def _described(kind: Any, limits: Sequence[Any]) -> str:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        for one in arguments[1:]:
            if (
                isinstance(one, FieldInfo)
                and isinstance(one.json_schema_extra, dict)
                and "range" in one.json_schema_extra
            ):
                return str(one.json_schema_extra["range"])
        inner = [m for a in arguments[1:] for m in (a.metadata if isinstance(a, FieldInfo) else [a])]
        return _described(arguments[0], [*inner, *limits])
    if origin in (Union, types.UnionType):
        return ", or ".join("left out" if a is type(None) else _described(a, limits) for a in arguments)
    if origin is Literal:
        return _either([str(a) for a in arguments])
    if origin is list:
        return f"a list of {_described(arguments[0], ())}"
    if origin is tuple:
        each = [_described(a, limits) for a in arguments if a is not Ellipsis]
        return f"{len(each)} numbers, {each[0]}" if Ellipsis not in arguments else f"numbers, {each[0]}"
    if kind is bool:
        return "true or false"
    if kind in (int, float):
        low, high = (_limit(limits, *names) for names in (("ge", "gt"), ("le", "lt")))
        whole = "a whole number, " if kind is int else ""
        return f"{whole}{low} to {high}" if low and high else f"{whole}any"
    return "text" if kind is str else "a file's path" if kind is Path else "a table"


def _limit(limits: Sequence[Any], with_it: str, without: str) -> str:
    for one in limits:
        if (value := getattr(one, with_it, None)) is not None:
            return f"{value:,}" if isinstance(value, int) else f"{value:,.10g}"
        if (value := getattr(one, without, None)) is not None:
            return f"{'above' if without == 'gt' else 'below'} {value:,}"
    return ""


def _either(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
