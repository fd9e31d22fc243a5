"""Tracks of road users in real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.scenario.motion_check import impossible_motions
from scan2sim.pipeline.scenario.scenario import from_tracks
from scan2sim.pipeline.steps.tracks import TracksParams
from scan2sim.pipeline.steps.tracks import tracks as tracks_step
from scan2sim.pipeline.tracking.tracks import Track, read_tracks
from tests.flows.command import scan2sim, stdout_of

pytestmark = pytest.mark.slow
INPUTS = {
    "cloud": "instances/*/cloud.npz", "instances": "instances/*/instances.geojson", "path": "path/*/path.npz",
    "moving": "dynamic_objects/*/moving.npz", "views": "views/*/views/views.json",
}  # fmt: skip


def follow(tmp_path: Path, *importing: object) -> list[Track]:
    """Tracks of a recording that is imported and classified."""
    stdout_of(scan2sim("import", *importing, "--out", tmp_path / "tile", timeout=900))
    stdout_of(scan2sim("segment", tmp_path / "tile", "--out", tmp_path / "run", timeout=1800))
    return tracks_of(tmp_path / "run" / "steps", tmp_path)


def tracks_of(steps: Path, out: Path) -> list[Track]:
    inputs = {name: next(steps.glob(pattern)) for name, pattern in INPUTS.items()}
    done = tracks_step(inputs, TracksParams(), out, silent)
    return read_tracks(done.files["tracks"])


def check_odometry_04(tracks: list[Track]) -> None:
    ego, *others = tracks
    moving = [track for track in others if track.moving and len(track.times) > 15]
    along = np.array([np.cos(ego.poses[0, 3]), np.sin(ego.poses[0, 3])])
    gap = {track.id: (track.poses[:, :2] - ego.at(track.times)[:, :2]) @ along for track in moving}
    towards = {track.id: float(np.cos(track.poses[:, 3] - ego.at(track.times)[:, 3]).mean()) for track in moving}
    (van,) = (t for t in moving if towards[t.id] > 0.9 and gap[t.id].min() > 0)
    assert van.category in ("van", "truck") and np.ptp(gap[van.id]) < 3
    assert 10 < np.median(van.speeds()) < 15
    assert any(towards[t.id] > 0.9 and gap[t.id].max() < 0 for t in moving), "the following car"
    oncoming = [t for t in moving if towards[t.id] < -0.9]
    assert len(oncoming) >= 2 and all(t.category == "car" for t in oncoming)
    assert not impossible_motions(from_tracks("odo04", tracks))


def check_raw_0009(tracks: list[Track], labels: Path, kitti: Path) -> None:
    """Each parked car labelled by KITTI within 25 m has a box near it in that photo; no track is moving."""
    assert [track.category for track in tracks if track.moving] == ["ego"]
    found: dict[int, list[np.ndarray]] = {}
    for row in _rows(kitti):
        found.setdefault(int(row[0]), []).append(np.array([float(word) for word in row[13:16]]))
    near = 0
    for row in _rows(labels):
        place = np.array([float(word) for word in row[13:16]]) + [0.06, 0, 0]  # camera 0 to camera 2
        if row[2] != "Car" or not 3 < place[2] < 25 or abs(place[0]) > 10:
            continue
        near += 1
        distance = min(np.hypot(*(one - place)[[0, 2]]) for one in found[int(row[0])])
        assert distance < 0.6, f"car {row[1]} in frame {row[0]}"
    assert near > 40


def _rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text(encoding="utf-8").splitlines()]


def test_van_ahead_and_oncoming_cars_are_tracked(real_data: Path, tmp_path: Path) -> None:
    check_odometry_04(follow(tmp_path, "kitti-odometry", real_data / "kitti_odo04_f00-24", "--max-range", 80))


def test_parked_cars_have_the_boxes_of_the_kitti_labels(real_data: Path, tmp_path: Path) -> None:
    source = real_data / "kitti_raw0009_f00-24"
    poses = source / "T_velo0_velo_icp_frames_0-24.txt"
    tracks = follow(tmp_path, "kitti-raw", source, "--poses", poses, "--max-range", 80)
    check_raw_0009(tracks, source / "tracking_gt_0001_frames_0-24.txt", tmp_path / "tracks_kitti.txt")
