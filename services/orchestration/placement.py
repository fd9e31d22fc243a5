"""Where a service may run: what sites can do, as measured, held against what the service needs (D3.2, section 2.2).

A site is what `scan2sim qos measure TOOLBOX --environment ... --out FILE` wrote of it: the toolbox ran there.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.qos.requirements import UNITS, Environment

LARGEST = 1_000_000
"""Bytes of a measurement's file."""


class _Row(BaseModel):
    metric: str
    required: str | None
    measured: float | None
    passed: bool | None


class Site(BaseModel):
    """What was measured of a service somewhere.

    Attributes:
        toolbox: that ran; environment: where.
        rows: metric by metric, what is required and what was measured.
    """

    toolbox: str
    environment: Environment
    rows: list[_Row]


@dataclass(frozen=True)
class Verdict:
    """On a site.

    Attributes:
        environment: that it is.
        fits: whether all needs are met; why: what isn't, sentence by sentence.
    """

    environment: Environment
    fits: bool
    why: tuple[str, ...]


def read(path: Path) -> Site:
    """A site's file.

    Raises:
        InputError: it is none.
    """
    remedy = "Make one: scan2sim qos measure TOOLBOX --environment edge --out FILE"
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(path, "is too large for a measurement", remedy)
        return Site.model_validate(json.loads(path.read_text("utf-8")))
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", remedy) from None
    except (ValueError, RecursionError) as error:
        said = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise InputError(path, f"is no measurement ({said})", remedy) from None


def place(service: str, sites: Sequence[Site]) -> list[Verdict]:
    """Which sites meet a service's needs, nearest to the robot first.

    Raises:
        InputError: a site's measurement is of another service.
    """
    for site in sites:
        if site.toolbox != service:
            cause = f"was measured with {site.toolbox}, not with {service}"
            raise InputError(site.environment, cause, f"scan2sim qos measure {service}")
    ordered = sorted(sites, key=lambda one: list(Environment).index(one.environment))
    return [_verdict(site) for site in ordered]


def _verdict(site: Site) -> Verdict:
    why = tuple(_said(row) for row in site.rows if row.passed is False)
    return Verdict(site.environment, not why, why)


def _said(row: _Row) -> str:
    unit = UNITS.get(row.metric, "")
    name = row.metric.replace("_", " ")
    if row.measured is None:
        return f"{name}: there is none, {row.required} {unit}".rstrip() + " is asked"
    if row.required is None:
        return f"{name}: answers don't come"
    return f"{name} is {row.measured:.4g} {unit}".rstrip() + f", {row.required} is asked"
