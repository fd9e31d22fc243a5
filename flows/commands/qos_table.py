"""Table that compares required with measured quality of service."""

from __future__ import annotations

from rich.table import Table

from scan2sim.services.qos.compare import MetricComparison
from scan2sim.services.qos.requirements import UNITS


def table(title: str, comparisons: list[MetricComparison]) -> Table:
    """A table with one row per metric: required, measured, pass or FAIL."""
    result_table = Table(title=title, title_justify="left")
    for name in ("metric", "required", "measured", ""):
        result_table.add_column(name, justify="right" if name == "measured" else "left")
    for row in comparisons:
        unit = UNITS.get(row.metric, "")
        required = f"{row.required} {unit}" if row.required else "-"
        outcome = {True: "[green]pass", False: "[red]FAIL", None: ""}[row.passed]
        result_table.add_row(row.metric.replace("_", " "), required, f"{or_dash(row.measured)} {unit}", outcome)
    return result_table


def or_dash(value: float | None) -> str:
    """The value with four significant digits; "-" for None."""
    return "-" if value is None else f"{value:.4g}"
