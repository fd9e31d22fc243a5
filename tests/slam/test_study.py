"""Compression study on a tiny corridor: cells, resuming, N/A."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.commands import study
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.study import Cell, Study, segments_of, truth_length
from scan2sim.flows.reports.study import Result, Tables, write
from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError
from scan2sim.pipeline.core.types import Camera, GpsTrack, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.images import video
from scan2sim.slam.steps.evaluate import lost_share
from scan2sim.slam.video import open_video
from scan2sim.slam.video_degradation import encode, scaled
from tests.slam.conftest import Drive


@pytest.fixture
def drive(corridor: Drive, tmp_path: Path) -> Path:
    """Folder of a drive, as users have it: video, ground truth, and GPS for the scale."""
    folder = tmp_path / "drive"
    folder.mkdir()
    shutil.copy(corridor.folder / "video.mp4", folder)
    trajectory_io.write(folder / "truth.csv", corridor.truth)
    fixes = np.column_stack([corridor.truth.times, corridor.truth.positions])
    rows = [",".join(map(str, fix)) for fix in fixes]
    (folder / "gps.csv").write_text("\n".join(["time,x,y,z", *rows]), encoding="utf-8")
    return folder


def studied(drive: Path, out: Path, *arguments: object) -> str:
    """Run the study; errors are raised."""
    words = ["slam", "study", drive, "--out", out, *arguments]
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.output


def rows_of(out: Path) -> dict[tuple[str, str], dict[str, str]]:
    return {(row["height"], row["bitrate_mbit_s"]): row for row in csv.DictReader((out / "table.csv").open())}


def test_cells_are_measured_and_cached(corridor: Drive, drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--heights", "128,256", "--bitrates", "1,0.1", "--rates", "10", "--jobs", 2)
    said = studied(drive, out, *options)
    rows, text = rows_of(out), (out / "table.md").read_text(encoding="utf-8")
    good, poor = rows["128", "1"], rows["128", "0.1"]
    assert not good["reason"] and float(good["global_mean_m"]) < 0.3 and int(good["frames"]) == len(corridor.truth)
    assert float(good["mbit_s"]) == pytest.approx(1.0, rel=0.5) and good["width"] == "256"
    assert float(poor["mbit_s"]) < 0.5 * float(good["mbit_s"])
    short = "too short for segments of 200 and 400 m (they need 240 and 480 m): local errors are over segments of 10 m"
    assert short in text and f"warning: the drive's ground truth is 21 m long, {short}" in said
    assert "scale from GPS along the path" in text
    tables = text.split("\n## ")[1:]
    for table, title, key in zip(
        tables,
        ("Global mean error", "Local median error over 10 m"),
        ("global_mean_m", "local_median_10_m"),
        strict=True,
    ):
        assert table.startswith(f"{title}, metres\n") and "| fps | Mbit/s | 128 px | 256 px |" in table
        assert f"| 10 | 1 | {float(good[key]):.2f} | N/A |" in table
    assert "- the source has only 128 px: 256 px, 0.1 Mbit/s, 10 fps; 256 px, 1 Mbit/s, 10 fps" in text
    error = f"global mean error {float(good['global_mean_m']):.2f} m"
    assert f"128 px, 1 Mbit/s, 10 fps: {error}" in said and "2 of 2 cells" in said and "1 of 2 cells, " in said
    assert len(rows) == 4 and {rows["256", b]["reason"] for b in ("1", "0.1")} == {"the source has only 128 px"}
    assert cv2.imread(str(out / "plot.png")) is not None

    assert (
        "8 of 8 results reused" in studied(drive, out, *options)
        and (out / "table.md").read_text(encoding="utf-8") == text
    )
    next((out / "steps" / "evaluate.h128_b1_f10").rglob("manifest.json")).unlink()
    assert "7 of 8 results reused" in studied(drive, out, *options)
    assert "2 of 8 results reused" in studied(drive, out, *options, "--set", "track.count=60"), "videos are kept"


def test_cell_without_features_is_lost_and_not_an_error(corridor: Drive, drive: Path, tmp_path: Path) -> None:
    (drive / "video.mp4").unlink()
    for i in range(20):
        cv2.imwrite(str(drive / f"{i}.png"), np.full((128, 256), 90, np.uint8))
    studied(drive, tmp_path / "out", "--heights", "64", "--bitrates", "1", "--rates", "5")
    row = rows_of(tmp_path / "out")["64", "1"]
    assert row["reason"] == "tracking lost on 100 % of the path" and row["frames"] == "10"
    text = (tmp_path / "out" / "table.md").read_text(encoding="utf-8")
    assert text.count("| 5 | 1 | lost (0 %) |") == 2 and "tracking was lost on more than 50 % of the path" in text


def test_failed_cell_is_na_and_others_finish(drive: Path, tmp_path: Path) -> None:
    (drive / "mask.png").write_bytes(b"no picture")
    said = studied(drive, tmp_path / "out", "--heights", "64", "--bitrates", "1,2", "--rates", "5")
    assert "format, or damaged): 64 px, 1 Mbit/s, 5 fps; 64 px, 2 Mbit/s, 5 fps" in said.replace("\n", "")


def test_an_interrupted_study_leaves_the_finished_cells_and_computes_the_others(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, options = tmp_path / "out", ("--heights", "64,128", "--bitrates", "1", "--rates", "5,10")
    on_event = study._Progress.on_event

    def interrupted(self: Any, task: Any, event: Any, fraction: float, message: str) -> None:
        on_event(self, task, event, fraction, message)
        if event == "done" and task.full_name.startswith("evaluate"):
            raise KeyboardInterrupt

    monkeypatch.setattr(study._Progress, "on_event", interrupted)
    with pytest.raises(KeyboardInterrupt):
        study.study(
            Study(source=drive, truth=drive / "truth.csv", heights=(64, 128), bitrates=(1.0,), rates=(5.0, 10.0)),
            out,
            Settings.read(None, []),
        )
    assert set(rows_of(out)) == {("64", "1")}, "the cheapest cell first"
    assert "3 of 4 cells have not run yet" in (out / "table.md").read_text(encoding="utf-8")
    monkeypatch.undo()
    (drive / "gps.csv").unlink()
    said = studied(drive, out, *options)
    assert "4 of 16 results reused" in said and "4 of 4 cells" in said and "have not run" not in said


def test_a_missing_encoder_is_reported_before_anything_runs(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "CODEC", "libx264_of_another_build")
    with pytest.raises(UnavailableError, match="needs the encoder libx264_of_another_build.*pip install"):
        studied(drive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_partly_tracked_and_lost_cells_are_marked_in_table_and_plot(tmp_path: Path) -> None:
    figures = {"global_mean_m": 1.234, "local_median_200_m": 0.5, "local_median_400_m": 0.7, "mbit_s": 1.0}
    grid = [Cell(height, 1.0, 15.0) for height in (512, 768, 1024, 1536)]
    results = {
        grid[0]: Result(figures | {"lost_share": 0.0}),
        grid[1]: Result(figures | {"lost_share": 0.2}),
        grid[2]: Result({"lost_share": 0.63, "mbit_s": 1.0}, "tracking lost on 63 % of the path"),
    }
    source: Any = type("V", (), {"path": Path("v"), "width": 3072, "height": 1536, "fps": 30.0})()
    write(tmp_path, Tables(source, False, "lm", 1000.0, (200.0, 400.0), grid, results))
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| 15 | 1 | 1.23 | 1.23 (80 %) | lost (37 %) | … |" in text and "| 15 | 1 | 0.70 |" in text
    assert "too short" not in text and "1 of 4 cells have not run yet" in text
    assert cv2.imread(str(tmp_path / "plot.png")) is not None


def test_a_lower_rate_drops_frames_and_keeps_their_times(corridor: Drive, tmp_path: Path) -> None:
    file = tmp_path / "a.mp4"
    seconds = encode(open_video(corridor.folder / "video.mp4"), file, size=(128, 64), bitrate=0.5, rate=5.0)
    made = open_video(file)
    frames = list(made.frames())
    assert (made.width, made.height, made.fps) == (128, 64, 5.0)
    assert np.allclose([f.time for f in frames], corridor.truth.times[::2], atol=1e-4)
    assert seconds == pytest.approx(3.6)
    for frame, grey in zip(frames, corridor.greys[::2], strict=True):
        small = cv2.resize(grey, (128, 64), interpolation=cv2.INTER_AREA).astype(float)
        assert np.abs(frame.grey - small).mean() < 12


@pytest.mark.parametrize(
    ("fps", "rate", "kept"), [(29.97, 30.0, 60), (29.97, 15.0, 30), (25.0, 15.0, 36), (60.0, 15.0, 15)]
)
def test_frames_are_sampled_evenly(tmp_path: Path, fps: float, rate: float, kept: int) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(60):
        cv2.imwrite(str(frames / f"{i}.png"), np.full((64, 128), i, np.uint8))
    encode(open_video(frames, fps=fps), tmp_path / "a.mp4", size=(128, 64), bitrate=1.0, rate=rate)
    times = np.array([f.time for f in open_video(tmp_path / "a.mp4").frames()])
    assert len(times) == kept and np.diff(times).max() < 1.5 / rate + 0.02


def test_segments_and_lost_share_follow_the_ground_truth() -> None:
    x = np.arange(0, 500.0)
    truth = Trajectory(x / 10, np.column_stack([x, 0 * x, 0 * x]))
    source: Any = type("V", (), {"count": 500, "fps": 10.0})()
    assert truth_length(source, truth) == pytest.approx(499, abs=1)
    source.count = 300
    assert truth_length(source, truth) == pytest.approx(300, abs=1)
    assert truth_length(source, GpsTrack(truth.times[::10], truth.positions[::10])) == pytest.approx(300, abs=12)
    assert [segments_of(length) for length in (1000, 479, 239, 5)] == [(200, 400), (200,), (100,), (10,)]
    unsure = x >= 375
    assert lost_share(replace(truth, unsure=unsure), truth) == pytest.approx(0.25, abs=0.003)


def test_a_camera_is_scaled_with_its_frames() -> None:
    camera = scaled(Camera("pinhole", 1242, 375, 721.5, 721.5, 609.6, 172.9), 188)
    assert (camera.width, camera.height) == (622, 188)
    assert camera.fx == pytest.approx(721.5 * 622 / 1242) and camera.cy == pytest.approx(173.4 * 188 / 375 - 0.5)


def test_invalid_numbers_and_missing_files_are_rejected(drive: Path, tmp_path: Path) -> None:
    for options, message in (
        (("--heights", "127"), "--heights"),
        (("--heights", ""), "--heights"),
        (("--bitrates", "0"), "--bitrates"),
        (("--rates", "ten"), "--rates"),
        (("--set", "track.windows=3"), "track.windows"),
    ):
        with pytest.raises(SettingError, match=message):
            studied(drive, tmp_path / "out", *options)
    with pytest.raises(InputError, match="file not found"):
        studied(tmp_path / "no.mp4", tmp_path / "out", "--truth", drive / "truth.csv")
    assert not (tmp_path / "out").exists()
