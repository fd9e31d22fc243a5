"""Ranges of numeric command options, in one table: an option of one name has one range in all commands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core.parameters import Buffer, Length, Range, Seed
from scan2sim.pipeline.core.step import Params


class NumericOptions(Params):
    """Values of numeric options by name, None where not given; the commands' help has their meanings."""

    hold_out: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    jobs: Annotated[int, Field(ge=0, le=1024)] | None = None
    cores: Annotated[int, Field(ge=1, le=1024)] | None = None
    length: Length | None = None
    buffer: Buffer | None = None
    points: Annotated[float, Field(ge=1000, le=1e9)] | None = None
    photos: Annotated[int, Field(ge=0, le=10_000)] | None = None
    seed: Seed | None = None
    minutes: Annotated[float, Field(ge=0, le=100_000)] | None = None
    steps: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    synthetic: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    segment: Annotated[float, Field(ge=1, le=1e7)] | None = None
    max_range: Range | None = None
    vertical_angle_offset: Annotated[float, Field(ge=-5, le=5)] | None = None
    count: Annotated[int, Field(ge=1, le=10_000)] | None = None
    levels: Annotated[int, Field(ge=1, le=6)] | None = None
    scale: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    days: Annotated[float, Field(ge=0.01, le=3650)] | None = None


def check(given: Mapping[str, Any]) -> None:
    """Check that numeric options are in their ranges; the command itself checks the others.

    Raises:
        SettingError: naming the option and its range.
    """
    for name, value in given.items():
        if name in NumericOptions.model_fields and isinstance(value, (int, float, tuple)):
            option = f"--{name.replace('_', '-')}"
            NumericOptions.of("", {name: value}, remedy=f"Change {option}; `--help` describes it")


def check_arguments(function: str, **numbers: float | None) -> None:
    """Check numbers that are given to a function of the Python API, by the ranges of the options of these names.

    Raises:
        SettingError: naming the function, the argument and its range.
    """
    NumericOptions.of(function, numbers, remedy="docs/reference/python.md describes it")
