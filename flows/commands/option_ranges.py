"""Ranges of the numbers that commands take as options, in one table: a name means the same in all commands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core.parameters import Buffer, Length, Range, Seed
from scan2sim.pipeline.core.step import Params


class Numbers(Params):
    """Options by their names, those that are given; the commands' help says what they mean."""

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
    segment: Annotated[float, Field(ge=1, le=1e7)] | None = None
    max_range: Range | None = None
    levels: Annotated[int, Field(ge=1, le=6)] | None = None
    scale: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    days: Annotated[float, Field(ge=0.01, le=3650)] | None = None


def check(given: Mapping[str, Any]) -> None:
    """See that numbers among a command's options are in their ranges; others are left to the command.

    Raises:
        SettingError: naming the option and its range.
    """
    for name, value in given.items():
        if name in Numbers.model_fields and isinstance(value, (int, float, tuple)):
            option = f"--{name.replace('_', '-')}"
            Numbers.of("", {name: value}, remedy=f"Give another {option}; `--help` says what it means")
