"""What was required against what was measured, as a table."""

from __future__ import annotations

from rich.table import Table

from scan2sim.services.qos.compare import Row
from scan2sim.services.qos.requirements import UNITS


def table(title: str, found: list[Row]) -> Table:
    """A line a metric."""
    made = Table(title=title, title_justify="left")
    for name in ("metric", "required", "measured", ""):
        made.add_column(name, justify="right" if name == "measured" else "left")
    for row in found:
        unit = UNITS.get(row.metric, "")
        required = f"{row.required} {unit}" if row.required else "-"
        verdict = {True: "[green]pass", False: "[red]FAIL", None: ""}[row.passed]
        made.add_row(row.metric.replace("_", " "), required, f"{or_dash(row.measured)} {unit}", verdict)
    return made


def or_dash(value: float | None) -> str:
    """Four digits; None: there is no such thing."""
    return "-" if value is None else f"{value:.4g}"
