"""Tables and plot of the compression study: influence of resolution, bit rate and frame rate on the error.

`table.md` has a table in the layout of tables 4 and 5 of 5G-ERA D3.2 for each error, `table.csv` all metrics with one
row per cell, `plot.png` the errors over the bit rate. Cells on which tracking was lost are marked so, with the share of
the path that was tracked; cells that can't be measured are N/A, with the reason.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from bench.slam.study.cells import MIN_TRUTH_SEGMENTS, SEGMENTS_M, Cell
from bench.slam.study.evaluate import LOST_SHARE_MAX
from scan2sim.pipeline.io.trajectory import atomic_write
from scan2sim.slam.video import Video

WHOLE_SHARE = 0.995
"""Share of the path from which on it counts as tracked entirely."""
COLOURS = ("#6baed6", "#2171b5", "#08306b", "#d9480f", "#2b8a3e", "#862e9c")
MARKERS = ("o", "s", "^", "D", "v", "P")
"""Colours and markers of the resolutions, which differ in brightness as well."""


@dataclass(frozen=True)
class Result:
    """Result of a cell: metrics by name, and the reason if there are no errors."""

    figures: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None

    @property
    def tracked(self) -> float | None:
        """Share of the path that was tracked; None if the cell failed."""
        lost = self.figures.get("lost_share")
        return None if lost is None else 1.0 - float(lost)

    @property
    def lost(self) -> bool:
        """Whether too little of the path was tracked for errors."""
        return self.reason is not None and self.tracked is not None


@dataclass(frozen=True)
class Tables:
    """Content of the tables.

    Attributes:
        video: the source.
        scaled_by_gps: whether GPS gives the scale.
        backend: optimiser of the tracking.
        length: length of the ground truth's path during the video, metres.
        segments: lengths of the segments of the local errors in metres.
        cells: all cells, in the order of the tables.
        results: of the finished, failed and impossible cells.
    """

    video: Video
    scaled_by_gps: bool
    backend: str
    length: float
    segments: tuple[float, ...]
    cells: Sequence[Cell]
    results: Mapping[Cell, Result]


def write(out: Path, tables: Tables) -> Path:
    """Write `table.md`, `table.csv` and `plot.png` into `out`, each atomically; returns the path of the first."""
    for name, text in (("table.md", _markdown(tables)), ("table.csv", _csv(tables.cells, tables.results))):
        with atomic_write(out / name) as fresh:
            fresh.write_text(text, encoding="utf-8")
    _plot(out / "plot.png", tables)
    return out / "table.md"


def missing_segments(tables: Tables) -> str | None:
    """Which segments of D3.2's errors the drive is too short for, and what is used instead; None if all fit."""
    missing = [s for s in SEGMENTS_M if s not in tables.segments]
    if not missing:
        return None
    return (
        f"the drive's ground truth is {tables.length:.0f} m long, too short for segments of {_metres(missing)} m "
        f"(they need {_metres([MIN_TRUTH_SEGMENTS * s for s in missing])} m): "
        f"local errors are over segments of {_metres(tables.segments)} m"
    )


def summary(result: Result | None, segments: Sequence[float]) -> str:
    """A cell's errors in a line, or why there are none."""
    if result is None or result.reason:
        return str(result and result.reason)
    values = [(title, result.figures.get(key)) for key, title in _errors(segments)]
    return ", ".join(f"{title} {value:.2f} m" for title, value in values if value is not None)


def _metres(lengths: Sequence[float]) -> str:
    return " and ".join(f"{length:g}" for length in lengths)


def _errors(segments: Sequence[float]) -> tuple[tuple[str, str], ...]:
    """Keys and titles of the errors."""
    local = ((f"local_median_{s:g}_m", f"local median error over {s:g} m") for s in segments)
    return ("global_mean_m", "global mean error"), *local


def _markdown(tables: Tables) -> str:
    """A table for each error in the layout of D3.2: rows are bit rates, columns resolutions, blocks frame rates."""
    video, cells, results = tables.video, tables.cells, tables.results
    heights, bitrates, rates = _axes(cells)
    lines = [
        "# Influence of vertical resolution, bit rate and frame rate",
        "",
        f"Source: `{video.path}`, {video.width}x{video.height}, {video.fps:.4g} fps, {tables.length:.0f} m. Errors in "
        "metres, in the ground plane, after alignment (rotation, scale, translation) with the ground truth (D3.2, "
        "section 4.1); "
        + ("scale from GPS along the path; " if tables.scaled_by_gps else "")
        + f"backend {tables.backend}.",
    ]
    if note := missing_segments(tables):
        lines += ["", f"{note[0].upper()}{note[1:]}."]
    for key, title in _errors(tables.segments):
        lines += ["", f"## {title[0].upper()}{title[1:]}, metres", ""]
        lines += [f"| fps | Mbit/s | {' | '.join(f'{height} px' for height in heights)} |"]
        lines += [f"| ---: | ---: |{' ---: |' * len(heights)}"]
        for rate, bitrate in product(rates, bitrates):
            figures = [_cell(results.get(Cell(height, bitrate, rate)), key) for height in heights]
            lines.append(f"| {rate:g} | {bitrate:g} | {' | '.join(figures)} |")
    shown = [(cell, results[cell]) for cell in cells if cell in results]
    if any(result.lost for _, result in shown):
        lines += [
            "",
            f"lost: tracking was lost on more than {100 * LOST_SHARE_MAX:.0f} % of the path; in parentheses, the share "
            "that was tracked.",
        ]
    if any(_partly_tracked(result) for _, result in shown):
        lines += ["", "A share in parentheses after an error: that share of the path was tracked, the rest bridged."]
    reasons: dict[str, list[str]] = {}
    for cell, result in shown:
        if result.reason and not result.lost:
            reasons.setdefault(result.reason, []).append(cell.label)
    if reasons:
        lines += ["", "N/A:", "", *(f"- {reason}: {'; '.join(where)}" for reason, where in reasons.items())]
    deviating = [
        f"- {cell.label}: {result.figures['mbit_s']:.3g}"
        for cell, result in shown
        if result.figures.get("mbit_s") and abs(result.figures["mbit_s"] / cell.bitrate - 1) > 0.1
    ]
    if deviating:
        lines += ["", "Cells whose bit rate deviates from the target by more than 10 %, in Mbit/s:", "", *deviating]
    missing = sum(cell not in results for cell in cells)
    if missing:
        lines += ["", f"{missing} of {len(cells)} cells have not run yet (…): run the command again."]
    return "\n".join(lines) + "\n"


def _axes(cells: Sequence[Cell]) -> tuple[list[int], list[float], list[float]]:
    """Heights and bit rates ascending, rates descending, as in the tables of D3.2."""
    heights, bitrates = sorted({c.height for c in cells}), sorted({c.bitrate for c in cells})
    return heights, bitrates, sorted({c.rate for c in cells}, reverse=True)


def _percent(result: Result) -> str:
    return "unknown" if result.tracked is None else f"{100 * result.tracked:.0f} %"


def _partly_tracked(result: Result) -> bool:
    return not result.reason and result.tracked is not None and result.tracked < WHOLE_SHARE


def _cell(result: Result | None, key: str) -> str:
    """A cell's text: the error, with the share tracked if that isn't all; lost, with that share; N/A; or not run."""
    if result is None:
        return "…"
    if result.lost:
        return f"lost ({_percent(result)})"
    value = None if result.reason else result.figures.get(key)
    if value is None:
        return "N/A"
    return f"{value:.2f}" + (f" ({_percent(result)})" if _partly_tracked(result) else "")


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


def _plot(file: Path, tables: Tables) -> None:
    """Write a PNG of errors over bit rates: a row of panels per frame rate, a line per resolution, log axes.

    Lost cells are crosses at the top. The background is opaque, so that the plot is readable on dark pages.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator

    heights, bitrates, rates = _axes(tables.cells)
    errors = _errors(tables.segments)
    figure = Figure(figsize=(4.3 * len(errors), 0.9 + 3.2 * len(rates)), dpi=110, layout="constrained")
    panels = figure.subplots(len(rates), len(errors), squeeze=False, sharex=True, sharey=True)
    any_error = any(not result.reason for result in tables.results.values())  # log axes need a value
    for (rate, row), (column, (key, title)) in product(zip(rates, panels, strict=True), enumerate(errors)):
        axes = row[column]
        for k, height in enumerate(heights):
            line = [(b, tables.results.get(Cell(height, b, rate))) for b in bitrates]
            at = {b: float(r.figures.get("mbit_s") or b) for b, r in line if r}
            points = [(at[b], (not r.reason and r.figures.get(key)) or math.nan) for b, r in line if r]  # lost: a gap
            style: Any = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
            axes.plot(*zip(*points, strict=True) if points else ((), ()), **style, linewidth=1.6, markersize=5,
                      label=f"{height} px")  # fmt: skip
            lost = [at[b] for b, r in line if r and r.lost]
            axes.plot(lost, [0.97 - 0.045 * k] * len(lost), "x", color=style["color"], markersize=6, markeredgewidth=2,
                      transform=axes.get_xaxis_transform())  # fmt: skip
        axes.set(xscale="log", yscale="log" if any_error else "linear", title=f"{rate:g} fps: {title}")
        axes.grid(which="both", alpha=0.25)
        if any_error:
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xticks(bitrates, [f"{b:g}" for b in bitrates])
        axes.minorticks_off()
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=len(heights))
    for axes in panels[-1]:
        axes.set_xlabel("Mbit/s")
    for axes in panels[:, 0]:
        axes.set_ylabel("error, m (x: lost)")
    with atomic_write(file) as fresh:
        figure.savefig(fresh, format="png", facecolor="white")
