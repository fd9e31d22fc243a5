"""Summary of a ROS bag: topics with type, rate, span and gaps, and what an import would use each for."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.pipeline.importers.bag.contents import Statistics, inspected, statistics
from scan2sim.pipeline.importers.bag.plan import BagParams, described
from scan2sim.pipeline.importers.bag.reader import opened

FIRST_YEAR = 1990
"""Log times before are not dates, but those of a simulation."""


def show_bag(path: Path, urdf: Path | None = None) -> None:
    """Print a summary of a bag, with the fixed joints of a URDF file.

    Raises:
        InputError: it isn't a bag, or is damaged. DataError: it has no messages.
        UnavailableError: the package `rosbags` isn't installed.
    """
    with opened(path) as bag:
        found = inspected(bag)
        uses, warnings, error = described(found, BagParams.model_validate({}), urdf)
        with progress("inspect") as report:
            numbers = statistics(bag, report)
        start = datetime.fromtimestamp(bag.start_ns / 1e9, UTC)
        begin = f"{start:%Y-%m-%d %H:%M:%S} UTC" if start.year >= FIRST_YEAR else f"{bag.start_ns / 1e9:.3f} s"
        kind = "ROS 2" if bag.ros2 else "ROS 1"
        count = sum(one.count for one in numbers.values())
        title = f"{kind} bag: {path}   {(bag.end_ns - bag.start_ns) / 1e9:,.1f} s from {begin}, {count:,} messages"
        table = Table(box=None, pad_edge=False)
        for name in ("topic", "type", "messages", "Hz", "span (s)", "gaps", "import"):
            table.add_column(name, justify="right" if name in ("messages", "Hz") else "left", overflow="fold")
        for name, one in numbers.items():
            package, _, short = bag.topics[name].type.rpartition("/")
            known = package.startswith(("sensor_msgs", "nav_msgs", "geometry_msgs", "tf"))
            table.add_row(
                escape(name), escape(short if known else bag.topics[name].type.replace("/msg/", "/")), f"{one.count:,}",
                f"{one.rate:.1f}", f"{one.start:.1f} - {one.end:.1f}", _gaps(one), escape(uses[name]),
            )  # fmt: skip
    console.print(f"[bold]{escape(title)}", highlight=False, soft_wrap=True)
    console.print(table, highlight=False)
    for text in warnings:
        warn(text)
    if error is not None:
        warn(f"`scan2sim import bag` would stop: {error}")


def _gaps(one: Statistics) -> str:
    return f"{one.gaps}, longest {one.longest:.1f} s" if one.gaps else "none"
