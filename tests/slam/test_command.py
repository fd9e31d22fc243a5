"""Command `scan2sim slam`: written files, output, and errors of invalid input."""

import io
import json
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import scan2sim.slam.odometry.video_odometry as tracking
from scan2sim.flows.cli import app
from scan2sim.flows.engine.planning import plan
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.video import Video, build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import InputError, LowConfidenceError, ScanError, exit_code
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.video_odometry import VERSION, track
from scan2sim.slam.steps.track import TRACK, TrackParams, tracker_of
from scan2sim.slam.video import open_video
from tests.slam.conftest import Drive


def command(*arguments: object) -> Result:
    """Run a command; errors are raised."""
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture(scope="session")
def done(corridor: Drive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("slam") / "out"
    result = command(
        "slam", corridor.folder / "video.mp4", "--out", out, "--colmap", "--adjust", "--set", "track.count=300"
    )
    return out, result.output


def test_trajectory_is_written_in_all_formats_and_missing_gps_reported(done: tuple[Path, str], corridor: Drive) -> None:
    out, said = done
    found = trajectory_io.read(out / "trajectory.csv")
    assert len(found) == len(corridor.truth)
    for name in ("trajectory.tum", "trajectory.kitti", "odometry.csv", "slam.json", "colmap/images.txt"):
        assert (out / name).is_file()
    assert "without GPS the scale is unknown" in said
    assert not (out / "trajectory.geojson").exists()
    assert json.loads((out / "slam.json").read_text(encoding="utf-8"))["frames"] == len(found)
    assert list((out / "steps").rglob("state*")) == []


def test_mostly_unsure_path_has_its_own_exit_code(corridor: Drive, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for k, grey in enumerate(corridor.greys[:12]):
        cv2.imwrite(str(frames / f"{k:03d}.png"), grey if k < 2 else np.full_like(grey, 9))
    with pytest.raises(LowConfidenceError, match="of the poses are extrapolated"):
        command("slam", frames, "--out", tmp_path / "out")
    assert (tmp_path / "out" / "trajectory.csv").is_file() and exit_code(LowConfidenceError("", "", "")) == 9
    losses = json.loads((tmp_path / "out" / "slam.json").read_text(encoding="utf-8"))["losses"]
    assert losses[0]["frame"] == "002.png" and losses[0]["measured"] < losses[0]["needed"]
    assert "tracked features" in losses[0]["failed"] and losses[0]["resumed"] is None


def test_changed_georeferencing_reuses_cached_tracking(corridor: Drive, tmp_path: Path) -> None:
    options = ("slam", corridor.folder / "video.mp4", "--out", tmp_path, "--set", "track.count=300", "--until", "0.5")
    command(*options)
    first = {path: path.stat().st_mtime_ns for path in tmp_path.glob("steps/track/*/*")}
    (tmp_path / "odometry.csv").write_text("of a run with --loops", encoding="utf-8")
    said = command(*options, "--local").output
    assert first and "1 of 2 results reused" in said.replace("\n", " ")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("steps/track/*/*")} == first
    assert not (tmp_path / "odometry.csv").exists(), "files of an earlier run remain"


def test_colmap_model_has_small_reprojection_errors(done: tuple[Path, str]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(done[0] / "colmap")
    assert model.num_points3D() > 100
    assert model.compute_mean_reprojection_error() < 1.0


def test_evaluate_prints_drift_and_local_errors(done: tuple[Path, str], corridor: Drive, tmp_path: Path) -> None:
    trajectory_io.write(tmp_path / "truth.csv", corridor.truth)
    said = command("slam", "evaluate", done[0] / "trajectory.csv", tmp_path / "truth.csv", "--segment", "5").output
    figures = dict(line.split() for line in said.splitlines() if len(line.split()) == 2)
    assert float(figures["drift_percent"]) < 1.0
    assert float(figures["local_median_5_m"]) < 0.1


@pytest.mark.parametrize("features", ["corners", "orb"])
def test_resumed_run_has_the_same_result(
    corridor: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, features: str
) -> None:
    monkeypatch.setattr(tracking, "CHECKPOINT_INTERVAL_S", 0.0)
    video, state = open_video(corridor.folder / "video.mp4"), tmp_path / "state.npz"
    params = TrackParams.model_validate({"count": 300, "features": features})

    def start(warn: Callable[[str], None]) -> Odometry:
        tracker, _ = tracker_of(corridor.camera, None, params, {})
        return Odometry(corridor.camera, params, tracker=tracker, keep=True, warn=warn)

    def interrupt(fraction: float, message: str = "") -> None:
        if message == "20 frames":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(video, start, state=state, report=interrupt)
    resumed = track(video, start, state=state)
    whole = track(video, start)
    assert resumed.names == whole.names
    first, second = ([run.odometry.pose_of(at) for at in run.odometry.placed] for run in (resumed, whole))
    assert np.array_equal(first, second)


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def damages(path: Path) -> dict[str, bytes]:
    """Invalid checkpoints, by the kind of damage."""
    whole, trap = path.read_bytes(), path.with_name("trap")
    objects = io.BytesIO()
    np.savez(objects, tree=np.array([Trap(trap)], dtype=object), data=np.zeros(3, np.uint8))
    foreign = io.BytesIO()
    np.savez(foreign, tree=np.frombuffer(b'{"names": {"kind": "Popen", "args": "id"}}', np.uint8), data=np.zeros(3))
    return {
        "a pickle": pickle.dumps(Trap(trap)), "objects": objects.getvalue(), "of others": foreign.getvalue(),
        "half": whole[: len(whole) // 2], "empty": b"", "flipped": whole[:999] + bytes([whole[999] ^ 1]) + whole[1000:],
    }  # fmt: skip


def test_damaged_or_foreign_checkpoint_is_ignored(
    corridor: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracking, "CHECKPOINT_INTERVAL_S", 0.0)
    video, state = open_video(corridor.folder / "video.mp4"), tmp_path / "state.npz"
    params = OdometryParams.model_validate({"count": 300})

    def start(warn: Callable[[str], None]) -> Odometry:
        return Odometry(corridor.camera, params, warn=warn)

    whole = track(video, start, until=0.5, state=state)
    for name, damaged in damages(state).items():
        state.write_bytes(damaged)
        again = track(video, start, until=0.5, state=state)
        assert [w for w in again.warnings if "damaged: starting from the beginning" in w], name
        assert again.names == whole.names and not (tmp_path / "trap").exists(), name


def test_checkpoint_of_other_code_or_other_input_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video, mask = tmp_path / "video.mp4", tmp_path / "mask.png"

    def mark(**changes: object) -> str:
        tasks = build_graph(Video.model_validate({"video": video, "mask": mask} | changes), Settings())
        return plan(tasks, Store(tmp_path / "steps"))[0].key

    video.write_bytes(b"one")
    mask.write_bytes(b"mask")
    before, times = mark(), video.stat()
    assert mark() == before
    (tmp_path / "moved").mkdir()
    assert mark(mask=Path(shutil.copy(mask, tmp_path / "moved"))) == before
    video.write_bytes(b"two")
    os.utime(video, ns=(times.st_atime_ns, times.st_mtime_ns))  # a copy with equal times and size
    assert mark() != before
    video.write_bytes(b"one")
    assert mark() == before != mark(every=2)
    monkeypatch.setattr("scan2sim.flows.pipelines.video.TRACK", replace(TRACK, version=VERSION + 1))
    assert mark() != before


@pytest.mark.parametrize(
    ("change", "arguments", "text"),
    [
        (lambda p: None, ("absent.mp4",), "file not found"),
        (lambda p: (p / "v.mp4").write_bytes(b"no video"), ("v.mp4",), "a readable video"),
        (lambda p: (p / "empty").mkdir(), ("empty",), "holds no images"),
        (lambda p: None, ("VIDEO", "--backend", "magic"), "unknown value 'magic'"),
        (lambda p: None, ("VIDEO", "--set", "track.windows=3"), "track.windows"),
        (lambda p: None, ("VIDEO", "--camera", "pinhole", "--until", "1"), "focal length unknown"),
        (lambda p: (p / "m.png").write_bytes(b"x"), ("VIDEO", "--mask", "m.png"), "can't be read"),
        (lambda p: (p / "g.csv").write_text("a,b\n1,2\n", encoding="utf-8"), ("VIDEO", "--gps", "g.csv"), "g.csv"),
    ],
)
def test_invalid_input_is_reported(
    corridor: Drive, tmp_path: Path, change: Callable[[Path], object], arguments: tuple[str, ...], text: str
) -> None:
    change(tmp_path)
    made = ("absent.mp4", "v.mp4", "empty", "m.png", "g.csv")
    video = corridor.folder / "video.mp4"
    shown = [video if a == "VIDEO" else tmp_path / a if a in made else a for a in arguments]
    with pytest.raises(ScanError) as error:
        command("slam", *shown, "--out", tmp_path / "out")
    assert text in str(error.value)


def test_truncated_video_and_changed_frame_size_are_reported(corridor: Drive, tmp_path: Path) -> None:
    for i in range(12):
        size = (256, 128) if i < 8 else (128, 64)
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), cv2.resize(corridor.greys[i], size))
    said: list[str] = []
    assert len(list(open_video(tmp_path).frames(warn=said.append))) == 8
    assert "128x64 instead of 256x128" in said[0]
    (tmp_path / "003.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"003\.png"):
        list(open_video(tmp_path).frames())


def test_truncated_video_is_read_up_to_its_end(corridor: Drive, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    assert av
    whole = tmp_path / "whole.ts"
    with av.open(str(corridor.folder / "video.mp4")) as source, av.open(str(whole), "w", format="mpegts") as sink:
        stream = sink.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                sink.mux(packet)
    half = tmp_path / "half.ts"
    half.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    frames = len(list(open_video(half).frames()))
    assert 5 < frames < len(corridor.greys)
    shutil.rmtree(tmp_path, ignore_errors=True)


def test_a_video_may_have_a_name_that_looks_like_an_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("2024-05-01T12:30:00.mp4")
    with Encoder(path, (64, 48), 10, preset="ultrafast", crf="23") as encoder:
        for i in range(3):
            encoder.add(np.full((72, 64), 60 * i, np.uint8), i / 10)
    assert path.is_file() and len(list(open_video(path).frames())) == 3


def test_frames_out_of_order_are_skipped_and_reported(corridor: Drive, tmp_path: Path) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), corridor.greys[i])
    (tmp_path / "times.txt").write_text("0\n0.1\n0.05\n0.2\n", encoding="utf-8")
    said: list[str] = []
    frames = list(open_video(tmp_path, times=tmp_path / "times.txt").frames(warn=said.append))
    assert [f.name for f in frames] == ["0.png", "1.png", "3.png"] and "out of order" in said[0]
    (tmp_path / "times.txt").write_text("0\n0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match="2 times for 4 images"):
        open_video(tmp_path, times=tmp_path / "times.txt")
