"""The rendered drive of the compression study: 1.1 km through the synthetic town, with traffic and changing light."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from scan2sim.data_samples import paths
from scan2sim.data_samples.drive import generate_drive

LENGTH_M, BLOCK_M, ROUNDED_M, SPEED = 1100.0, 450.0, 40.0, 25.0
"""The drive: its length, the distance between its two bends, their roundness, and its greatest speed in m/s."""
REPORT_INTERVAL_S = 10.0


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
