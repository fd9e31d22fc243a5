"""The benchmark that studies compression, on a tiny corridor; run as a program, as tests don't import benchmarks."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.io import trajectory as trajectory_io
from tests.slam.conftest import Drive

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def drive(corridor: Drive, tmp_path: Path) -> Path:
    """Folder of a drive: video, ground truth, and GPS for the scale."""
    folder = tmp_path / "drive"
    folder.mkdir()
    shutil.copy(corridor.folder / "video.mp4", folder)
    trajectory_io.write(folder / "truth.csv", corridor.truth)
    fixes = np.column_stack([corridor.truth.times, corridor.truth.positions])
    rows = [",".join(map(str, fix)) for fix in fixes]
    (folder / "gps.csv").write_text("\n".join(["time,x,y,z", *rows]), encoding="utf-8")
    return folder


def studied(drive: Path, out: Path, *options: object, code: int = 0) -> str:
    """Output of the program."""
    words = [sys.executable, "-m", "bench.slam.study", drive, "--out", out, *options]
    done = subprocess.run([str(word) for word in words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


def test_cells_are_measured_and_cached(corridor: Drive, drive: Path, tmp_path: Path) -> None:
    out, options = tmp_path / "out", ("--heights", "128,256", "--bitrates", "1,0.1", "--rates", "10", "--jobs", 2)
    said = studied(drive, out, *options)
    text = (out / "study" / "table.md").read_text(encoding="utf-8")
    rows = {(row["height"], row["bitrate_mbit_s"]): row for row in csv.DictReader((out / "study" / "table.csv").open())}
    good, poor = rows["128", "1"], rows["128", "0.1"]
    assert not good["reason"] and float(good["global_mean_m"]) < 0.3 and int(good["frames"]) == len(corridor.truth)
    assert float(good["mbit_s"]) == pytest.approx(1.0, rel=0.5) and good["width"] == "256"
    assert float(poor["mbit_s"]) < 0.5 * float(good["mbit_s"])
    assert "warning: the drive's ground truth is 21 m long" in said and "local errors are over segments of 10 m" in text
    assert f"| 10 | 1 | {float(good['global_mean_m']):.2f} | N/A |" in text and "scale from GPS along the path" in text
    assert {rows["256", b]["reason"] for b in ("1", "0.1")} == {"the source has only 128 px"}
    assert cv2.imread(str(out / "study" / "plot.png")) is not None
    result = json.loads(said.splitlines()[-1].removeprefix("RESULT "))
    assert (result["cells"], result["lost"], result["failed"]) == (4, 0, 2) and result["global_mean_m"] < 0.3

    assert "8 of 8 results reused" in studied(drive, out, *options)
    assert (out / "study" / "table.md").read_text(encoding="utf-8") == text


def test_lost_cells_and_impossible_grids_are_reported(drive: Path, tmp_path: Path) -> None:
    (drive / "video.mp4").unlink()
    for i in range(20):
        cv2.imwrite(str(drive / f"{i}.png"), np.full((128, 256), 90, np.uint8))
    studied(drive, tmp_path / "out", "--heights", "64", "--bitrates", "1", "--rates", "5")
    text = (tmp_path / "out" / "study" / "table.md").read_text(encoding="utf-8")
    assert text.count("| 5 | 1 | lost (0 %) |") == 2 and "tracking was lost on more than 50 % of the path" in text
    assert "error: --heights: must be numbers" in studied(drive, tmp_path / "odd", "--heights", "127", code=1)
