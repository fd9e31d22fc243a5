"""Tables and plot of the compression study: influence of resolution, bit rate and frame rate on the error.

`table.md` has the layout of tables 4 and 5 of 5G-ERA D3.2, `table.csv` has all metrics with one row per cell. Cells
that can't be measured are N/A, with the reason.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2sim.flows.pipelines.study import Cell
from scan2sim.pipeline.io.trajectory import atomic_write
from scan2sim.slam.trajectory.evaluate import SEGMENT_M
from scan2sim.slam.video import Video


@dataclass(frozen=True)
class Result:
    """Result of a cell: metrics by name, and the reason if they are N/A."""

    figures: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None


@dataclass(frozen=True)
class Tables:
    """Content of the tables.

    Attributes:
        video: the source.
        scaled_by_gps: whether GPS gives the scale.
        backend: optimiser of the tracking.
        segment: length of the segments of the local error in metres.
        cells: all cells, in the order of the tables.
        results: of the finished, failed and impossible cells.
    """

    video: Video
    scaled_by_gps: bool
    backend: str
    segment: float
    cells: Sequence[Cell]
    results: Mapping[Cell, Result]


def write(out: Path, tables: Tables) -> Path:
    """Write `table.md`, `table.csv` and `plot.png` into `out`, each atomically; returns the path of the first."""
    for name, text in (("table.md", _markdown(tables)), ("table.csv", _csv(tables.cells, tables.results))):
        with atomic_write(out / name) as fresh:
            fresh.write_text(text, encoding="utf-8")
    _plot(out / "plot.png", tables.segment, tables.cells, tables.results)
    return out / "table.md"


def _errors(segment: float) -> tuple[tuple[str, str], ...]:
    """Keys and titles of the two error metrics."""
    return ("global_mean_m", "Global mean error"), (f"local_median_{segment:g}_m", f"Local median error {segment:g}")


def _markdown(tables: Tables) -> str:
    """Tables in the layout of D3.2: rows are bit rates, columns resolutions, blocks frame rates and errors."""
    video, segment, cells, results = tables.video, tables.segment, tables.cells, tables.results
    heights, bitrates, rates = _axes(cells)
    errors = _errors(segment)
    lines = [
        "# Influence of vertical resolution, bit rate and frame rate",
        "",
        f"Source: `{video.path}`, {video.width}x{video.height}, {video.fps:.4g} fps. Errors in metres, in the ground "
        "plane, after alignment (rotation, scale, translation) with the ground truth (D3.2, section 4.1); "
        + ("scale from GPS along the path; " if tables.scaled_by_gps else "")
        + f"backend {tables.backend}.",
    ]
    if segment != SEGMENT_M:
        lines.append(
            f"The ground truth is too short for segments of {SEGMENT_M:g} m: segments of {segment:g} m are used."
        )
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
    deviating = [
        f"{cell.height} px {cell.bitrate:g} Mbit/s {cell.rate:g} fps: {result.figures['mbit_s']:.3g}"
        for cell, result in ((cell, results[cell]) for cell in cells if cell in results)
        if result.figures.get("mbit_s") and abs(result.figures["mbit_s"] / cell.bitrate - 1) > 0.1
    ]
    if deviating:
        lines += [
            "",
            "Cells whose bit rate deviates from the target by more than 10 %, in Mbit/s:",
            "",
            *(f"- {o}" for o in deviating),
        ]
    missing = sum(cell not in results for cell in cells)
    if missing:
        lines += ["", f"{missing} of {len(cells)} cells have not run yet (…)."]
    return "\n".join(lines) + "\n"


def _axes(cells: Sequence[Cell]) -> tuple[list[int], list[float], list[float]]:
    """Heights and bit rates ascending, rates descending, as in the tables of D3.2."""
    heights, bitrates = sorted({c.height for c in cells}), sorted({c.bitrate for c in cells})
    return heights, bitrates, sorted({c.rate for c in cells}, reverse=True)


def _cell(result: Result | None, key: str) -> str:
    if result is None:
        return "…"
    value = None if result.reason else result.figures.get(key)
    return "N/A" if value is None else f"{value:.2f}"


def _csv(cells: Sequence[Cell], results: Mapping[Cell, Result]) -> str:
    """CSV table with all metrics, one row per cell."""
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
    """Write a PNG: errors over bit rate; one line per resolution, one row of panels per frame rate."""
    from matplotlib.figure import Figure

    heights, bitrates, rates = _axes(cells)
    figure = Figure(figsize=(12, 1 + 4 * len(rates)), dpi=110, layout="constrained")
    panels = figure.subplots(len(rates), 2, squeeze=False, sharex=True, sharey="col")
    colours = ["#9cc4e4", "#3f8fd2", "#1f5fbf", "#0b2f6b", "#c2410c", "#f0a818"]
    for rate, row in zip(rates, panels, strict=True):
        for (key, title), axes in zip(_errors(segment), row, strict=True):
            for k, height in enumerate(heights):
                cells_of_line = [(b, results.get(Cell(height, b, rate))) for b in bitrates]
                points = [
                    (b, r.figures[key])
                    for b, r in cells_of_line
                    if r and not r.reason and r.figures.get(key) is not None
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
        axes.set_xlabel("target bit rate, Mbit/s")
        axes.set_ylim(bottom=0)  # only now have all panels that share this axis been drawn
    with atomic_write(file) as fresh:
        figure.savefig(fresh, format="png")
