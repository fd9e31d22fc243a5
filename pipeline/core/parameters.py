"""Shared parameter types with their ranges, and the text that describes a range in messages.

Ranges are generous: a value outside is a typing error, or would take more memory or time than any machine has. Memory
that depends on the data as well (texels of a surface, pixels of a map) is estimated by the step, which rejects it.
"""

from __future__ import annotations

import types
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import AfterValidator, Field
from pydantic.fields import FieldInfo

Voxel = Annotated[float, Field(ge=0.005, le=100)]
"""Voxel edge in metres; the lower limit is below the noise of any scanner."""
Texel = Annotated[float, Field(ge=0.0005, le=10)]
"""Texture resolution in metres."""
Distance = Annotated[float, Field(ge=0.001, le=10_000)]
"""Search radius or tolerance in metres."""
Depth = Annotated[float, Field(ge=0, le=10)]
"""Depth tolerance in metres."""
Cosine = Annotated[float, Field(ge=0, le=0.99)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
"""Coordinate in a CRS, metres or feet; the limit is two and a half times the circumference of the earth."""
PlanPoint = tuple[Coordinate, Coordinate]
Metres = Annotated[float, Field(ge=0, le=10_000)]
Length = Annotated[float, Field(ge=1, le=100_000)]
Stretch = Annotated[float, Field(ge=1, le=10_000)]
Buffer = Annotated[float, Field(ge=0, le=1000)]
Range = Annotated[float, Field(ge=0.1, le=10_000)]
Pixels = Annotated[float, Field(ge=-1_000_000, le=1_000_000)]
Focal = Annotated[float, Field(ge=1, le=1_000_000)]
"""Focal length in pixels."""
Rate = Annotated[float, Field(ge=0.01, le=1000)]
"""Frame rate in Hz."""
Shift = Annotated[float, Field(ge=-1e10, le=1e10)]
"""Clock offset in seconds; one of the clocks may count from 1970."""
Seconds = Annotated[float, Field(ge=0.001, le=604_800)]
"""Duration in seconds, up to a week."""
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
"""Seed of a random number generator."""
ExposureStops = Annotated[float, Field(ge=0.001, le=20)]
"""Exposure difference in EV."""
Device = Annotated[
    str,
    Field(
        pattern=r"^(auto|numba|(cpu|cuda|mps|xpu)(:[0-9]{1,3})?)$",
        json_schema_extra={"range": "auto, numba, cpu, cuda, mps or xpu; cuda:1 for the second"},
    ),
]
"""Compute device: "numba" only in the step `texture`, the others are names of torch and onnxruntime devices."""
MAX_NAME = 100
NAME = rf"^[A-Za-z0-9_]{{1,{MAX_NAME}}}$"
Name = Annotated[str, Field(pattern=NAME)]


def is_reserved(name: str) -> bool:
    """Whether simulators can't have a model of this name: `world` is the root of SDF, MJCF and the exported URDF."""
    return name == "world" or (name.startswith("__") and name.endswith("__"))


def _not_reserved(name: str) -> str:
    if is_reserved(name):
        raise ValueError(f"{name!r} is reserved by simulators (SDF, MuJoCo); choose another name")
    return name


WorldName = Annotated[Name, AfterValidator(_not_reserved)]
"""Names of tiles and surveys, which become names of folders, files, and models of simulators."""


def _no_nul(text: Any) -> Any:
    if "\0" in str(text) or len(str(text)) > 4096:
        raise ValueError("not a valid path")
    return text


FileName = Annotated[str, AfterValidator(_no_nul)]
"""Path of a file as text; "" for none."""
File = Annotated[Path, AfterValidator(_no_nul)]


def described(field: FieldInfo) -> str:
    """The allowed values of a parameter as text: "0.005 to 100"."""
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
        return ", or ".join("unset" if a is type(None) else _described(a, limits) for a in arguments)
    if origin is Literal:
        return _either([str(a) for a in arguments])
    if origin is list:
        return f"a list of {_described(arguments[0], ())}"
    if origin is tuple and arguments[0] is str:
        return "a list of text"
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
