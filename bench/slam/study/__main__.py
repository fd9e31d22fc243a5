"""The study of compression (5G-ERA D3.2, tables 4 and 5): errors by image height, bit rate and frame rate of a video.

`python -m bench.slam.study [DRIVE] [--out DIR] [--heights 192,256,384,512] [--bitrates .1,.2,.5,1,2,4] [--rates 30,15]`

DRIVE is a folder (`video.mp4`, `truth.csv`, `gps.csv`, `mask.png`), a 360-degree video, or a folder of its frames; by
default a drive of 1.1 km is rendered (`bench/slam/study/rendered_drive.py`), which with the default grid takes about 40
minutes of a core. Its frames have about a third of the height of D3.2's, and a tenth of the bit rate, so about as many
bits per pixel. D3.2's own grid: `--heights 512,768,1024,1536 --bitrates 1,2,5,10,20,40`.

Each cell of the grid is encoded (`libx264`, `superfast`) and tracked, and its path is compared with the ground truth.
`OUT/study/table.md`, `table.csv` and `plot.png` have the global error, and local ones over segments of 200 and 400 m; a
drive that is too short for them gets shorter ones, with a warning. A cell on which tracking was lost is marked with
the share of the path that was tracked; images and frame rates are never scaled up. The cheapest cells come first, the
tables are updated meanwhile, and the same command with the same `--out` computes only the missing cells.

Prints a table of all errors, and ends with `RESULT {json}`: number of cells that ran, lost track and failed; the least
errors with their cells. `--table` prints both for the cells so far, and runs nothing.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path
from typing import Any

from bench.paths import ROOT
from bench.slam.study.cells import Study
from bench.slam.study.rendered_drive import rendered_drive
from bench.slam.study.run import study
from bench.slam.study.tables import WHOLE_SHARE
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.errors import ScanError

FILES = {"truth": "truth.csv", "gps": "gps.csv", "mask": "mask.png"}
ERRORS = ("global_mean_m", "local_median_200_m", "local_median_400_m")


def page_table(rows: list[dict[str, str]]) -> str:
    """Markdown table of the errors in metres: global mean, local medians over 200 and 400 m; share tracked if not all.

    Args:
        rows: of the study's `table.csv`.
    """
    cells = {(row["rate_fps"], row["bitrate_mbit_s"], row["height"]): row for row in rows}
    rates, bitrates, heights = (sorted({key[k] for key in cells}, key=float) for k in range(3))
    lines = [f"| fps | Mbit/s | {' | '.join(f'{height} px' for height in heights)} |"]
    lines += [f"| ---: | ---: |{' ---: |' * len(heights)}"]
    for rate in rates[::-1]:
        for bitrate in bitrates:
            texts = [_text(cells.get((rate, bitrate, height))) for height in heights]
            lines.append(f"| {rate} | {bitrate} | {' | '.join(texts)} |")
    return "\n".join(lines)


def _text(row: dict[str, str] | None) -> str:
    if row is None:
        return "…"
    if row["reason"]:
        lost = "tracking lost" in row["reason"]
        return f"lost ({100 * (1 - float(row['lost_share'])):.0f} %)" if lost else "N/A"
    errors = ", ".join(f"{float(row[key]):.2f}".removeprefix("0") for key in ERRORS if row.get(key))
    tracked = 1 - float(row["lost_share"])
    return errors + (f" ({100 * tracked:.0f} %)" if tracked < WHOLE_SHARE else "")


def main() -> None:
    """Render the drive if none is given, run the study, print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path, nargs="?", help="default: a rendered drive")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "compression")
    parser.add_argument("--truth", type=Path, help="trajectory or GPS track; default: truth.csv of the drive")
    parser.add_argument(
        "--gps", type=Path, help="GPS track that gives the scale; default: gps.csv of the drive, if any"
    )
    parser.add_argument("--mask", type=Path, help="ego-vehicle mask; default: mask.png of the drive, if any")
    parser.add_argument("--heights", default="192,256,384,512", help="image heights, pixels")
    parser.add_argument("--bitrates", default="0.1,0.2,0.5,1,2,4", help="bit rates, Mbit/s")
    parser.add_argument("--rates", default="30,15", help="frame rates")
    parser.add_argument("--jobs", type=int, default=1, help="cells that are computed at the same time")
    parser.add_argument("--set", action="append", default=[], help="setting of a step, as `scan2sim slam --set`")
    parser.add_argument("--table", action="store_true", help="print the results so far, without running anything")
    args = parser.parse_args()
    if not args.table:
        try:
            run(args)
        except ScanError as error:
            sys.exit(f"error: {error}")
    rows = list(csv.DictReader((args.out / "study" / "table.csv").open(encoding="utf-8")))
    print(page_table(rows))
    print("RESULT " + json.dumps(result(rows)))


def run(args: argparse.Namespace) -> None:
    """Render the drive and run the study, or what is missing of both."""
    settings = Settings.read(None, args.set)
    grid = {key: _numbers(getattr(args, key)) for key in ("heights", "bitrates", "rates")}
    drive: Path = args.drive or rendered_drive(
        args.out / f"drive_{max(grid['heights'])}", int(max(grid["heights"])), max(grid["rates"]),
        2e6 * max(grid["bitrates"]),
    )  # fmt: skip
    files = {key: getattr(args, key) or _existing(drive / name) for key, name in FILES.items()}
    study(
        Study.of("", {"source": drive} | files | grid, remedy="Change the option"),
        args.out / "study",
        settings,
        args.jobs,
    )


def result(rows: list[dict[str, str]]) -> dict[str, Any]:
    """Number of cells that ran, lost track and failed, and the smallest errors with their cells."""
    lost = sum("tracking lost" in row["reason"] for row in rows)
    found: dict[str, Any] = {
        "cells": len(rows),
        "lost": lost,
        "failed": sum(bool(row["reason"]) for row in rows) - lost,
    }
    for key in ERRORS:
        measured = [(float(row[key]), row) for row in rows if row.get(key)]
        if measured:
            error, row = min(measured, key=lambda pair: pair[0])
            found[key] = round(error, 3)
            found[key.removesuffix("_m") + "_at"] = (
                f"{row['height']} px, {row['bitrate_mbit_s']} Mbit/s, {row['rate_fps']} fps"
            )
    return found


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None


def _numbers(text: str) -> list[float]:
    return [int(part) if part.isdigit() else float(part) for part in text.split(",")]


if __name__ == "__main__":
    main()
