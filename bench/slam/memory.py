"""Peak memory of odometry over a growing number of frames: `python -m bench.slam.memory DRIVE COUNT` in a new process.

A rendered drive of half a minute (512x256) is played forwards and backwards, so that tracking is never lost.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path

from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams

SECONDS, HEIGHT, FPS = 34.0, 256, 15.0
FRAME_COUNTS = (1000, 3000, 10_000)


def memory(out: Path) -> dict[str, float | None]:
    """Relative growth of the peak from 1,000 to 10,000 frames."""
    from scan2sim.data_samples import paths
    from scan2sim.data_samples.drive import generate_drive

    folder = out / "drive_small"
    if not (folder / "video.mp4").is_file():
        generate_drive(folder, paths.town_path(0, 600), seconds=SECONDS, fps=FPS, height=HEIGHT, lossless=True)
    command = [sys.executable, "-m", "bench.slam.memory", str(folder), str(FRAME_COUNTS[-1])]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    peaks = json.loads(done.stdout)
    return {"memory_10000_growth": peaks[str(FRAME_COUNTS[-1])] / peaks[str(FRAME_COUNTS[0])] - 1}


def there_and_back(folder: Path) -> Iterator[U8]:
    """(H, W) frames of a drive forwards and backwards without end, read from files to save memory."""
    import cv2

    files = sorted((folder / "frames").glob("*.png"))
    for lap in count():
        for file in (files[1:], files[-2::-1])[lap % 2]:
            yield cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)


def peaks(folder: Path, frames: int) -> dict[int, float]:
    """Peak memory in GB by number of frames."""
    import cv2

    mask, found = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE), {}
    odometry = Odometry(Camera("equirectangular", 2 * HEIGHT, HEIGHT), OdometryParams(count=300), mask=mask)
    for number, grey in enumerate(islice(there_and_back(folder), frames), 1):
        odometry.add(number / FPS, grey)
        if number in FRAME_COUNTS:
            found[number] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            unsure = sum(p.unsure for p in odometry.placed) / number
            print(f"{number} frames: {found[number]:.3f} GB, {unsure:.1%} unsure", file=sys.stderr, flush=True)
    return found


if __name__ == "__main__":
    print(json.dumps(peaks(Path(sys.argv[1]), int(sys.argv[2]))))
