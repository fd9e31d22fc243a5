"""Comparison of required with measured quality of service, as a table and as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from scan2sim.flows.commands.display import console, print_line
from scan2sim.services.qos.compare import MetricComparison, passed, summary
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, UNITS


def table(title: str, comparisons: list[MetricComparison]) -> Table:
    """A table with one row per metric: required, measured, pass or FAIL."""
    result_table = Table(title=title, title_justify="left")
    for name in ("metric", "required", "measured", ""):
        result_table.add_column(name, justify="right" if name == "measured" else "left")
    for row in comparisons:
        unit = UNITS.get(row.metric, "")
        required = f"{row.required} {unit}" if row.required else "-"
        outcome = {True: "[green]pass", False: "[red]FAIL", None: row.note if row.required else ""}[row.passed]
        bounds = f" ({or_dash(row.bounds[0])} to {or_dash(row.bounds[1])})" if row.bounds else ""
        measured = f"{or_dash(row.measured)}{bounds} {unit}"
        result_table.add_row(row.metric.replace("_", " "), required, measured, outcome)
    return result_table


Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="JSON file for the measurements; input of `orchestrate place`.")
]


def report(
    service: str,
    params: Any,
    title: str,
    comparisons: list[MetricComparison],
    lines: list[str],
    *,
    as_json: bool,
    out: Path | None,
    **more: Any,
) -> None:
    """Print a comparison, as JSON or as a table with lines below it, and write it to a file.

    Args:
        service: its name; `params` has the `environment` it was measured in.
        title: title of the table.
        comparisons, lines: what was measured.
        as_json: print JSON.
        out: JSON file; None: none.
        more: further parts of the JSON.
    """
    text = json.dumps(document(comparisons, toolbox=service, environment=params.environment, **more), indent=1)
    if as_json:
        print(text)
    else:
        console.print(table(title, comparisons))
        outcomes = (("service", NETWORK_METRICS), ("machine", MACHINE_METRICS))
        for line in (*lines, *(f"{name}: {summary(comparisons, metrics)}" for name, metrics in outcomes)):
            print_line(line)
    if out:
        out.write_text(text, encoding="utf-8")


def document(comparisons: list[MetricComparison], **more: Any) -> dict[str, Any]:
    """Comparison as JSON, in which values that aren't finite are null."""
    return {
        **finite(more),
        "passed": passed(comparisons, NETWORK_METRICS),
        "machine_passed": passed(comparisons, MACHINE_METRICS),
        "rows": [finite(asdict(row)) | {"required": str(row.required or "") or None} for row in comparisons],
    }


def finite(value: Any) -> Any:
    """The same with null for numbers that aren't finite, which JSON doesn't have."""
    if isinstance(value, dict):
        return {name: finite(one) for name, one in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def or_dash(value: float | None) -> str:
    """The value with four significant digits; "-" for None."""
    return "-" if value is None else f"{value:.4g}"
