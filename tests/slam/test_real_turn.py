"""A real drive with a sharp turn (KITTI odometry 01): tracked in one map, its published lens refined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.steps.track import TrackParams, track_video


def test_a_real_turn_is_tracked_in_one_map_with_a_refined_lens(real_data: Path, tmp_path: Path) -> None:
    drive = real_data / "kitti_odo01_vo51"
    if not drive.is_dir():
        pytest.skip(f"no recording of KITTI odometry 01: {drive} doesn't exist")
    params = TrackParams(focal=718.856, centre=(607.1928, 185.2157))
    done = track_video({"video": drive / "image_0"}, params, tmp_path, silent, tmp_path)
    assert done.metrics["maps"] == 1 and done.metrics["losses"] == []
    found = MapCheckpoint.read(tmp_path / "map.npz")
    assert not any(placed.unsure for placed in found.placed)
    places = np.stack([(found.map.keyframes[p.keyframe].T_world_cam @ p.T_key_cam)[:3, 3] for p in found.placed])
    truth = np.loadtxt(drive / "poses.txt").reshape(-1, 3, 4)[:, :, 3]
    off = umeyama(places, truth, scaled=True).apply(places) - truth
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.1  # of 52 m; 0.29 m with the published lens
    lens = done.metrics["lens"]
    assert lens["how"].startswith("refinement of the given lens") and 0.005 < lens["k1"] < 0.025
    assert lens["focal"] == pytest.approx(params.focal, rel=0.02)
    assert any("--fixed-lens keeps it" in text for text in done.warnings)
