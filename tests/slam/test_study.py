"""The study of compression, on a tiny corridor: cells, resuming, and what is N/A."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.errors import InputError, SettingError
from scan2sim.pipeline.types import Camera, GpsTrack, Trajectory
from scan2sim.slam import study as study_module
from scan2sim.slam.odometry import OdometryParams
from scan2sim.slam.study import Cell, Result, Source, measure, study
from scan2sim.slam.video import open_video
from tests.slam.conftest import Drive

PARAMS = OdometryParams.model_validate({})


def source_of(drive: Drive, **changes: Any) -> Source:
    """What cells of a drive share."""
    video = open_video(drive.folder / "video.mp4")
    made = Source(video, drive.camera, drive.truth, None, None, PARAMS, "lm", 10.0, False)
    return replace(made, **changes)


def test_cells_are_measured_kept_and_not_run_again(corridor: Drive, tmp_path: Path) -> None:
    out, told = tmp_path / "out", []
    gps = GpsTrack(corridor.truth.times, corridor.truth.positions)
    (out / "cells").mkdir(parents=True)
    (out / "cells" / ".h128_b1_f10.99999999.part.mp4").write_bytes(b"of a run that was killed")
    asked: dict[str, Any] = {
        "params": PARAMS, "gps": gps, "heights": (128, 256), "bitrates": (1, 0.1), "rates": (10,), "jobs": 2,
        "report": lambda share, text="": told.append(text),
    }  # fmt: skip
    table = study(corridor.folder, corridor.truth, out, **asked)
    cells = sorted((out / "cells").iterdir())
    assert [c.name for c in cells] == ["h128_b0.1_f10.json", "h128_b1_f10.json"]
    good = json.loads(cells[1].read_text())
    figures = good["figures"]
    assert good["reason"] is None and figures["global_mean_m"] < 0.3 and figures["frames"] == len(corridor.truth)
    assert figures["mbit_s"] == pytest.approx(1.0, rel=0.5) and figures["width"] == 256
    assert json.loads(cells[0].read_text())["figures"]["mbit_s"] < 0.5 * figures["mbit_s"]
    text = table.read_text()
    assert "segments of 400 m: they are of 10 m" in text
    assert "| fps | Mbit/s | global, 128 px | global, 256 px | local, 128 px | local, 256 px |" in text
    assert told[0].startswith("2 of 4 cells") and told[-1] == "done"
    row = next(line for line in text.splitlines() if line.startswith("| 10 | 1 |"))
    local = figures["local_median_10_m"]
    assert row == f"| 10 | 1 | {figures['global_mean_m']:.2f} | N/A | {local:.2f} | N/A |"
    assert "- the source has only 128 px: 256 px 0.1 Mbit/s 10 fps, 256 px 1 Mbit/s 10 fps" in text
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert len(rows) == 4 and {r["reason"] for r in rows if r["height"] == "256"} == {"the source has only 128 px"}
    assert cv2.imread(str(out / "plot.png")) is not None

    before = {c: c.stat().st_mtime_ns for c in cells}
    study(corridor.folder, corridor.truth, out, **asked)  # nothing is left to run
    assert {c: c.stat().st_mtime_ns for c in cells} == before and (out / "table.md").read_text() == text
    same = good["of"]
    assert study_module._kept(out / "cells", Cell(128, 1.0, 10.0), same) == Result(figures, None)
    cells[1].write_text(cells[1].read_text()[:100])  # killed while writing: but files appear whole
    assert study_module._kept(out / "cells", Cell(128, 1.0, 10.0), same) is None
    other = source_of(corridor, gps=gps, params=OdometryParams.model_validate({"count": 300}))
    assert study_module._identity(other) != same == study_module._identity(source_of(corridor, gps=gps))


def test_a_cell_that_sees_nothing_is_na_with_its_reason(corridor: Drive, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(20):
        cv2.imwrite(str(frames / f"{i}.png"), np.full((128, 256), 90, np.uint8))
    video = open_video(frames, fps=10.0)
    result = measure(Cell(64, 1.0, 5.0), source_of(corridor, video=video), tmp_path / "a.mp4")
    assert result.reason == "lost for 100 % of the way" and result.figures["frames"] == 10


def test_a_process_that_dies_takes_no_other_with_it_and_is_run_again(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return os._exit, (9,)

    bomb: Any = Bomb()
    cells = [Cell(64, 1.0, 5.0), Cell(64, 2.0, 5.0)]
    found = dict(study_module._run(cells, bomb, tmp_path, {}, 2, lambda done, running: None))
    assert [found[c].reason for c in cells] == ["its process died (exit status 9), perhaps out of memory"] * 2
    assert not list(tmp_path.iterdir())


def test_a_lower_rate_drops_frames_and_keeps_their_times(corridor: Drive, tmp_path: Path) -> None:
    file = tmp_path / "a.mp4"
    seconds = study_module._encode(open_video(corridor.folder / "video.mp4"), file, Cell(64, 0.5, 5.0), (128, 64), 1)
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
def test_frames_are_chosen_evenly(tmp_path: Path, fps: float, rate: float, kept: int) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(60):
        cv2.imwrite(str(frames / f"{i}.png"), np.full((64, 128), i, np.uint8))
    study_module._encode(open_video(frames, fps=fps), tmp_path / "a.mp4", Cell(64, 1.0, rate), (128, 64), 1)
    times = np.array([f.time for f in open_video(tmp_path / "a.mp4").frames()])
    assert len(times) == kept and np.diff(times).max() < 1.5 / rate + 0.02


def test_the_truth_decides_on_the_segments_and_on_what_was_lost() -> None:
    x = np.arange(0, 500.0)
    truth = Trajectory(x / 10, np.column_stack([x, 0 * x, 0 * x]))
    video: Any = type("V", (), {"count": 500, "fps": 10.0})()
    assert study_module._segment(video, truth) == 400
    video.count = 300
    assert study_module._segment(video, truth) == 200
    assert study_module._segment(video, GpsTrack(truth.times[::10], truth.positions[::10])) == 200
    unsure = x >= 375
    assert study_module._lost(replace(truth, unsure=unsure), truth) == pytest.approx(0.25, abs=0.003)


def test_a_camera_is_scaled_with_its_frames() -> None:
    camera = study_module._scaled(Camera("pinhole", 1242, 375, 721.5, 721.5, 609.6, 172.9), 188)
    assert (camera.width, camera.height) == (622, 188)
    assert camera.fx == pytest.approx(721.5 * 622 / 1242) and camera.cy == pytest.approx(173.4 * 188 / 375 - 0.5)


def test_bad_numbers_and_a_mask_of_another_size_are_refused(corridor: Drive, tmp_path: Path) -> None:
    for asked, message in (
        ({"heights": (127,)}, "even"),
        ({"heights": ()}, "there are none"),
        ({"bitrates": (0,)}, "less than"),
        ({"jobs": 0}, "jobs"),
    ):
        with pytest.raises(SettingError, match=message):
            study(corridor.folder, corridor.truth, tmp_path / "out", params=PARAMS, **asked)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"is 256x128, its mask 10x10"):
        study(corridor.folder, corridor.truth, tmp_path / "out", params=PARAMS, mask=np.ones((10, 10), np.uint8))
    with pytest.raises(InputError, match="is missing"):
        study(tmp_path / "no.mp4", corridor.truth, tmp_path / "out", params=PARAMS)
    assert not (tmp_path / "out").exists()
