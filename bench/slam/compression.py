"""The study of compression (5G-ERA D3.2, tables 4 and 5) on a rendered drive of 1.1 km.

`python -m bench.slam.compression [--out DIR] [--heights 192,256,384,512] [--bitrates .1,.2,.5,1,2,4] [--rates 30,15]`

Renders the drive (as high as the highest frames, with the highest frame rate, at twice the highest bit rate), then runs
`scan2sim slam study` on it. Run the command again after an interruption: rendered frames and finished cells are kept.
By default the frames have about a third of the height of D3.2's, and a tenth of the bit rate, so about as many bits per
pixel, which takes about 40 minutes of a core. D3.2's own grid: `--heights 512,768,1024,1536 --bitrates 1,2,5,10,20,40`.

Prints a table of all errors, and ends with `RESULT {json}`: number of cells that ran, lost track and failed; the least
errors with their cells. `--table` prints both for the cells so far, and runs nothing.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import time
from pathlib import Path

from bench.paths import ROOT
from bench.segmentation.run import scan2sim
from scan2sim.data_samples import paths
from scan2sim.data_samples.drive import generate_drive
from scan2sim.flows.reports.study import WHOLE_SHARE

LENGTH_M, BLOCK_M, ROUNDED_M, SPEED = 1100.0, 450.0, 40.0, 25.0
"""The drive: its length, the distance between its two bends, their roundness, and its greatest speed in m/s."""
REPORT_INTERVAL_S = 10.0
ERRORS = ("global_mean_m", "local_median_200_m", "local_median_400_m")


def rendered_drive(folder: Path, height: int, fps: float, bitrate: float) -> Path:
    """The drive's folder; rendered if it has no video, from the frames on that an interrupted run left."""
    if (folder / "video.mp4").is_file():
        return folder
    began, shown, first = time.monotonic(), -REPORT_INTERVAL_S, len(list(folder.glob("frames/*.png")))

    def report(fraction: float, message: str = "") -> None:
        nonlocal shown
        spent = time.monotonic() - began
        if spent - shown >= REPORT_INTERVAL_S:
            shown = spent
            print(f"{100 * fraction:5.1f} %  {message}", flush=True)

    print(
        f"rendering {LENGTH_M:.0f} m, {2 * height}x{height}, {fps:g} fps; {first} frames are there already", flush=True
    )
    path = paths.zigzag_path(LENGTH_M, BLOCK_M, ROUNDED_M)
    generate_drive(
        folder, path, speed=SPEED, fps=fps, height=height, bitrate=bitrate, samples=2, lossless=True, resume=True,
        report=report,
    )  # fmt: skip
    shutil.rmtree(folder / "frames")  # the study would prefer them to the video, but PNGs take longer to read
    return folder


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
    """Render the drive, run the study, print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "compression")
    parser.add_argument("--heights", default="192,256,384,512", help="image heights, pixels")
    parser.add_argument("--bitrates", default="0.1,0.2,0.5,1,2,4", help="bit rates, Mbit/s")
    parser.add_argument("--rates", default="30,15", help="frame rates")
    parser.add_argument("--jobs", type=int, default=1, help="cells that are computed at the same time")
    parser.add_argument("--table", action="store_true", help="print the results so far, without running anything")
    args = parser.parse_args()
    if not args.table:
        run(args)
    rows = list(csv.DictReader((args.out / "study" / "table.csv").open(encoding="utf-8")))
    print(page_table(rows))
    result: dict[str, object] = {"cells": len(rows), "lost": sum("tracking lost" in row["reason"] for row in rows)}
    result["failed"] = sum(bool(row["reason"]) for row in rows) - int(str(result["lost"]))
    for key in ERRORS:
        measured = [(float(row[key]), row) for row in rows if row.get(key)]
        if measured:
            error, row = min(measured, key=lambda pair: pair[0])
            result[key] = round(error, 3)
            result[key.removesuffix("_m") + "_at"] = (
                f"{row['height']} px, {row['bitrate_mbit_s']} Mbit/s, {row['rate_fps']} fps"
            )
    print("RESULT " + json.dumps(result))


def run(args: argparse.Namespace) -> None:
    """Render the drive and run the study, or what is missing of both."""
    height, fps = max(map(int, args.heights.split(","))), max(map(float, args.rates.split(",")))
    bitrate = 2e6 * max(map(float, args.bitrates.split(",")))
    drive = rendered_drive(args.out / f"drive_{height}", height, fps, bitrate)
    grid = ("--heights", args.heights, "--bitrates", args.bitrates, "--rates", args.rates)
    scan2sim("slam", "study", drive, "--out", args.out / "study", *grid, "--jobs", args.jobs)


if __name__ == "__main__":
    main()
