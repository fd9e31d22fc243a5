"""The tables and the plot of the study of compression: how resolution, bit rate and frame rate change the error.

`table.md` has the layout of D3.2's tables 4 and 5, `table.csv` all figures, a row a cell. What can't be measured is
N/A, with the reason.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2sim.flows.pipelines.study import Cell
from scan2sim.pipeline.io.trajectory import replacing
from scan2sim.slam.trajectory.evaluate import SEGMENT
from scan2sim.slam.video import Video


@dataclass(frozen=True)
class Result:
    """Of a cell: figures by name, and why they are N/A if they are."""

    figures: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None


@dataclass(frozen=True)
class Tables:
    """What the tables tell.

    Attributes:
        video: the source.
        by_gps: whether GPS ties the scale.
        backend: of the tracking.
        segment: metres, of the local error.
        cells: all, in the tables' order.
        results: of those that are done, or can't be.
    """

    video: Video
    by_gps: bool
    backend: str
    segment: float
    cells: Sequence[Cell]
    results: Mapping[Cell, Result]


def write(out: Path, tables: Tables) -> Path:
    """Write `table.md`, `table.csv` and `plot.png` into `out`, each whole or not at all; returns the first."""
    for name, text in (("table.md", _markdown(tables)), ("table.csv", _csv(tables.cells, tables.results))):
        with replacing(out / name) as fresh:
            fresh.write_text(text, encoding="utf-8")
    _plot(out / "plot.png", tables.segment, tables.cells, tables.results)
    return out / "table.md"


def _errors(segment: float) -> tuple[tuple[str, str], ...]:
    """Keys and titles of the two errors."""
    return ("global_mean_m", "Global mean error"), (f"local_median_{segment:g}_m", f"Local median error {segment:g}")


def _markdown(tables: Tables) -> str:
    """The mission's layout: rows are bit rates, columns resolutions, blocks frame rates and the two errors."""
    video, segment, cells, results = tables.video, tables.segment, tables.cells, tables.results
    heights, bitrates, rates = _axes(cells)
    errors = _errors(segment)
    lines = [
        "# Influence of vertical resolution, bit rate and frame rate",
        "",
        f"Source: `{video.path}`, {video.width}x{video.height}, {video.fps:.4g} fps. Errors in metres, in the ground "
        "plane, after rotation, scale and translation onto the truth (D3.2, section 4.1); "
        + ("scale along the way by GPS; " if tables.by_gps else "")
        + f"backend {tables.backend}.",
    ]
    if segment != SEGMENT:
        lines.append(f"The truth is too short for segments of {SEGMENT:g} m: they are of {segment:g} m.")
    titles = [f"{title.split(' ')[0].lower()}, {height} px" for _, title in errors for height in heights]
    lines += [
        "",
        f"Left: {errors[0][1].lower()} [m]. Right: {errors[1][1].lower()} [m].",
        "",
        f"| fps | Mbit/s | {' | '.join(titles)} |",
        f"| ---: | ---: |{' ---: |' * len(titles)}",
    ]
    for rate in rates:
        for bitrate in bitrates:
            row = [results.get(Cell(height, bitrate, rate)) for height in heights]
            figures = [_cell(result, key) for key, _ in errors for result in row]
            lines.append(f"| {rate:g} | {bitrate:g} | {' | '.join(figures)} |")
    reasons: dict[str, list[str]] = {}
    for cell in cells:
        if cell in results and results[cell].reason:
            where = f"{cell.height} px {cell.bitrate:g} Mbit/s {cell.rate:g} fps"
            reasons.setdefault(str(results[cell].reason), []).append(where)
    if reasons:
        lines += ["", "N/A:", "", *(f"- {reason}: {', '.join(where)}" for reason, where in reasons.items())]
    off = [
        f"{cell.height} px {cell.bitrate:g} Mbit/s {cell.rate:g} fps: {result.figures['mbit_s']:.3g}"
        for cell, result in ((cell, results[cell]) for cell in cells if cell in results)
        if result.figures.get("mbit_s") and abs(result.figures["mbit_s"] / cell.bitrate - 1) > 0.1
    ]
    if off:
        lines += [
            "",
            "Bit rates that came out more than 10 % off what was asked, Mbit/s:",
            "",
            *(f"- {o}" for o in off),
        ]
    missing = sum(cell not in results for cell in cells)
    if missing:
        lines += ["", f"{missing} of {len(cells)} cells are still to be run (…)."]
    return "\n".join(lines) + "\n"


def _axes(cells: Sequence[Cell]) -> tuple[list[int], list[float], list[float]]:
    """Heights and bit rates ascending, rates descending, as in the mission's tables."""
    heights, bitrates = sorted({c.height for c in cells}), sorted({c.bitrate for c in cells})
    return heights, bitrates, sorted({c.rate for c in cells}, reverse=True)


def _cell(result: Result | None, key: str) -> str:
    if result is None:
        return "…"
    value = None if result.reason else result.figures.get(key)
    return "N/A" if value is None else f"{value:.2f}"


def _csv(cells: Sequence[Cell], results: Mapping[Cell, Result]) -> str:
    """A row a cell, with all figures."""
    names = list(dict.fromkeys(name for cell in cells if cell in results for name in results[cell].figures))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["height", "bitrate_mbit_s", "rate_fps", *names, "reason"])
    for cell in cells:
        if cell in results:
            result = results[cell]
            values = [result.figures.get(name) for name in names]
            table.writerow([cell.height, f"{cell.bitrate:g}", f"{cell.rate:g}", *values, result.reason])
    return text.getvalue()


def _plot(file: Path, segment: float, cells: Sequence[Cell], results: Mapping[Cell, Result]) -> None:
    """Write a PNG: errors against bit rate, a line a resolution, a row of panels a frame rate."""
    from matplotlib.figure import Figure

    heights, bitrates, rates = _axes(cells)
    figure = Figure(figsize=(12, 1 + 4 * len(rates)), dpi=110, layout="constrained")
    panels = figure.subplots(len(rates), 2, squeeze=False, sharex=True, sharey="col")
    colours = ["#9cc4e4", "#3f8fd2", "#1f5fbf", "#0b2f6b", "#c2410c", "#f0a818"]
    for rate, row in zip(rates, panels, strict=True):
        for (key, title), axes in zip(_errors(segment), row, strict=True):
            for k, height in enumerate(heights):
                found = [(b, results.get(Cell(height, b, rate))) for b in bitrates]
                points = [
                    (b, r.figures[key]) for b, r in found if r and not r.reason and r.figures.get(key) is not None
                ]
                label = f"{height} px" + ("" if points else " (N/A)")
                x, y = zip(*points, strict=True) if points else ((), ())
                axes.plot(x, y, "o-", color=colours[k % len(colours)], linewidth=1.6, markersize=4, label=label)
            axes.set_xscale("log")
            axes.set_xticks(bitrates, [f"{b:g}" for b in bitrates])
            axes.minorticks_off()
            axes.set(title=f"{title}{' m' * title[-1:].isdigit()}, {rate:g} fps", ylabel="m")
            axes.set_xlim(min(bitrates) / 1.2, max(bitrates) * 1.2)
            axes.grid(alpha=0.3)
            axes.legend()
    for axes in panels[-1]:
        axes.set_xlabel("Mbit/s asked for")
        axes.set_ylim(bottom=0)  # all that share this axis have drawn
    with replacing(file) as fresh:
        figure.savefig(fresh, format="png")
