"""A drive whose lens is refined is tracked once: odometry with the refined lens replays the recorded features."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, U8, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.odometry import video_odometry
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.track_log import NO_IMAGE, RecordingTracker, Replay, TrackLog
from scan2sim.slam.steps.track import TrackParams, track_video
from scan2sim.slam.trackers import Tracks
from scan2sim.slam.trackers.corners import CornerTracker
from scan2sim.slam.virtual_cameras import VirtualViews
from tests.slam.conftest import PERSPECTIVE

WRONG = 1.04
"""Ratio of the given focal length and the true one."""


class Killed(Exception):
    """The run was interrupted."""


@pytest.fixture(scope="module")
def frames(turn: tuple[Trajectory, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for k, grey in enumerate(turn[1]):
        cv2.imwrite(str(folder / f"{k:03d}.png"), grey)
    return folder


def tracked(frames: Path, out: Path) -> Done:
    """Track the turn with a focal length that is wrong; `out` holds the checkpoints, too."""
    centre = PERSPECTIVE.cx, PERSPECTIVE.cy
    out.mkdir(exist_ok=True)
    params = TrackParams(focal=WRONG * PERSPECTIVE.fx, centre=centre, camera="pinhole")
    return track_video({"video": frames}, params, out, silent, out)


def positions(out: Path) -> F64:
    found = MapCheckpoint.read(out / "map.npz")
    return np.stack([(found.map.keyframes[p.keyframe].T_world_cam @ p.T_key_cam)[:3, 3] for p in found.placed])


def ate(found: F64, truth: Trajectory) -> float:
    off = umeyama(found, truth.positions, scaled=True).apply(found) - truth.positions
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def counted(monkeypatch: pytest.MonkeyPatch, fail_at: int | None = None, kind: type = CornerTracker) -> list[int]:
    """Count the frames that a tracker processes; raise `Killed` at one of them."""
    calls: list[int] = []
    track: Callable[..., float] = kind.track  # type: ignore[attr-defined]

    def counting(self: Any, grey: U8, expected: F64 | None = None) -> float:
        calls.append(1)
        if len(calls) == fail_at:
            raise Killed
        return track(self, grey, expected)

    monkeypatch.setattr(kind, "track", counting)
    return calls


@pytest.fixture(scope="module")
def whole(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("whole")
    return out, tracked(frames, out)


def test_images_are_tracked_once(
    frames: Path, turn: tuple[Trajectory, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = counted(monkeypatch)
    done = tracked(frames, tmp_path)
    assert done.metrics["lens"]["how"].startswith("refinement of the given lens")
    assert len(calls) == len(turn[1])
    assert done.metrics["frames"] == len(turn[1]) and done.metrics["losses"] == []


def test_replayed_path_is_as_accurate_as_tracking_again(
    frames: Path, turn: tuple[Trajectory, np.ndarray], whole: tuple[Path, Done], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(TrackLog, "read", lambda _: None)
    calls = counted(monkeypatch)
    again = tracked(frames, tmp_path)
    assert len(calls) >= 2 * len(turn[1])
    assert whole[1].metrics["lens"]["focal"] == pytest.approx(again.metrics["lens"]["focal"], rel=0.005)
    assert ate(positions(whole[0]), turn[0]) < 1.1 * ate(positions(tmp_path), turn[0]) + 1e-3


def test_a_replay_with_the_same_lens_repeats_the_path(turn: tuple[Trajectory, np.ndarray], tmp_path: Path) -> None:
    tracker = CornerTracker(VirtualViews(PERSPECTIVE), None, 400)
    recorder = RecordingTracker(tracker, PERSPECTIVE, tmp_path / "tracks.bin")
    params = OdometryParams(count=400)
    first = Odometry(PERSPECTIVE, params, tracker=recorder)
    for time, grey in zip(turn[0].times, turn[1], strict=True):
        first.add(float(time), grey)
    recorder.finish([p.time for p in first.placed], [str(k) for k in range(len(turn[1]))], ["a warning"])
    log = TrackLog.read(tmp_path / "tracks.bin")
    assert log is not None and log.warnings == ["a warning"]
    second = Odometry(PERSPECTIVE, params, tracker=Replay(log, PERSPECTIVE))
    for frame in log.frames():
        second.add(frame.time, frame.grey)
    paths = [np.stack([one.pose_of(p)[:3, 3] for p in one.placed]) for one in (first, second)]
    length = np.linalg.norm(np.diff(paths[0], axis=0), axis=1).sum()
    assert len(first.map.keyframes) == len(second.map.keyframes)
    assert np.abs(paths[0] - paths[1]).max() < 1e-3 * length


@pytest.mark.parametrize(("kind", "fail_at"), [(CornerTracker, 20), (Replay, 1), (Replay, 20)])
def test_an_interrupted_run_resumes_in_either_pass(
    frames: Path, whole: tuple[Path, Done], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type, fail_at: int
) -> None:
    monkeypatch.setattr(video_odometry, "CHECKPOINT_INTERVAL_S", 0.0)
    with monkeypatch.context() as killing:
        counted(killing, fail_at, kind)
        with pytest.raises(Killed):
            tracked(frames, tmp_path)
    calls = counted(monkeypatch), counted(monkeypatch, kind=Replay)
    done = tracked(frames, tmp_path)
    count = whole[1].metrics["frames"]
    assert [len(one) for one in calls] == ([count - 19, count] if kind is CornerTracker else [0, count + 1 - fail_at])
    assert done.metrics["lens"] == whole[1].metrics["lens"]
    assert np.allclose(positions(tmp_path), positions(whole[0]), atol=1e-9)


def test_drive_is_tracked_again_if_the_replay_is_lost(
    frames: Path, turn: tuple[Trajectory, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = Replay.track

    def losing(self: Replay, grey: U8, expected: F64 | None = None) -> float:
        share = track(self, grey, expected)
        if self._frame == 15:
            self.drop(self.tracks.ids)
        return share

    monkeypatch.setattr(Replay, "track", losing)
    calls = counted(monkeypatch)
    done = tracked(frames, tmp_path)
    assert len(calls) >= 2 * len(turn[1]) and done.metrics["losses"] == []


def test_a_damaged_log_is_not_replayed(frames: Path, whole: tuple[Path, Done], tmp_path: Path) -> None:
    log = whole[0] / "tracks.bin"
    for file in (log, log.with_suffix(".json")):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    copy = tmp_path / log.name
    assert TrackLog.read(copy) is not None
    copy.write_bytes(log.read_bytes()[:-100])
    assert TrackLog.read(copy) is None
    copy.with_suffix(".json").unlink()
    assert TrackLog.read(copy) is None


def test_long_log_is_not_loaded_into_memory(tmp_path: Path) -> None:
    count, length = 500, 4000
    recorder = RecordingTracker(Moving(count), PERSPECTIVE, tmp_path / "tracks.bin")
    tracemalloc.start()
    for _ in range(length):
        recorder.track(NO_IMAGE)
        recorder.refill()
    recorder.finish([float(k) for k in range(length)], [str(k) for k in range(length)], [])
    log = TrackLog.read(tmp_path / "tracks.bin")
    assert log is not None
    replay = Replay(log, PERSPECTIVE)
    for frame in log.frames():
        replay.track(frame.grey)
        replay.drop(replay.tracks.ids[::2])
        replay.refill()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(replay.tracks) > 0
    assert peak < 0.25 * (tmp_path / "tracks.bin").stat().st_size


class Moving:
    """A tracker half of whose features are replaced in every frame."""

    def __init__(self, count: int) -> None:
        self.count, self.next, self.images = count, 0, [NO_IMAGE]
        self.tracks = Tracks()

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        self.tracks = self.tracks.keep(np.arange(len(self.tracks)) >= self.count // 2)
        return 0.5

    def drop(self, ids: np.ndarray) -> None:
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        new = self.count - len(self.tracks)
        ids = np.concatenate([self.tracks.ids, self.next + np.arange(new)])
        self.next += new
        self.tracks = Tracks(ids, np.tile([0.0, 0.0, 1.0], (len(ids), 1)))
        return new
