"""Compare measured sites with a service's requirements to find where it may run (D3.2, section 2.2).

A site is a file written by `scan2sim qos measure SERVICE --environment ... --out FILE`, which ran the toolbox there.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.qos.requirements import UNITS, Environment

MAX_FILE_BYTES = 1_000_000
"""Maximum size of a measurement file."""


class _Row(BaseModel):
    metric: str
    required: str | None
    measured: float | None
    passed: bool | None


class Site(BaseModel):
    """Measurement of a service at a site.

    Attributes:
        toolbox: toolbox that was measured.
        environment: environment of the site.
        rows: required and measured value of each metric.
    """

    toolbox: str
    environment: Environment
    rows: list[_Row]


@dataclass(frozen=True)
class Placement:
    """Result of the comparison for one site.

    Attributes:
        environment: environment of the site.
        fits: whether all requirements are met.
        unmet: unmet requirements, one sentence each.
        unknown: required metrics that weren't measured or decided.
    """

    environment: Environment
    fits: bool
    unmet: tuple[str, ...]
    unknown: tuple[str, ...] = ()


def read(path: Path) -> Site:
    """Read a measurement file.

    Raises:
        InputError: not a measurement file.
    """
    remedy = "Create one: scan2sim qos measure SERVICE --environment edge --out FILE"
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(path, "too large for a measurement file", remedy)
        return Site.model_validate(json.loads(path.read_text("utf-8")))
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", remedy) from None
    except (ValueError, RecursionError) as error:
        cause = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise InputError(path, f"not a measurement file ({cause})", remedy) from None


def place(service: str, sites: Sequence[Site]) -> list[Placement]:
    """Compare sites with a service's requirements, nearest to the robot first.

    Raises:
        InputError: a measurement is of another service.
    """
    for site in sites:
        if site.toolbox != service:
            cause = f"measured with {site.toolbox}, not with {service}"
            raise InputError(site.environment, cause, f"Measure it: scan2sim qos measure {service}")
    ordered = sorted(sites, key=lambda one: list(Environment).index(one.environment))
    return [_compare(site) for site in ordered]


def _compare(site: Site) -> Placement:
    unmet = tuple(_unmet(row) for row in site.rows if row.passed is False)
    unknown = tuple(row.metric.replace("_", " ") for row in site.rows if row.required and row.passed is None)
    return Placement(site.environment, not unmet, unmet, unknown)


def _unmet(row: _Row) -> str:
    unit = UNITS.get(row.metric, "")
    name = row.metric.replace("_", " ")
    if row.metric == "response_time" and (row.measured is None or row.required is None):
        return f"{name}: some requests were not answered"
    if row.measured is None:
        return f"{name}: not available, required: {row.required} {unit}".rstrip()
    return f"{name}: {row.measured:.4g} {unit}".rstrip() + f", required: {row.required}"
