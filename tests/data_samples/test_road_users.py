"""Traffic of the synthetic street, and its true tracks."""

from pathlib import Path

import numpy as np

from scan2sim.data_samples.layout import FRAME
from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.tracking.tracks import read_tracks


def test_returns_of_road_users_lie_in_their_true_boxes(tmp_path: Path) -> None:
    generate(tmp_path, length=40, points=80_000, photos=0, seed=1, traffic=True, truth_density=1)
    tracks = read_tracks(tmp_path / "truth" / "tracks.json")
    assert {track.category for track in tracks if track.moving} == {"car", "cyclist", "pedestrian"}
    cloud = las.read(tmp_path / "cloud.laz", FRAME)
    assert cloud.classification is not None and cloud.time is not None
    index = np.flatnonzero(np.isin(cloud.classification, (CODE["vehicle"], CODE["person"])))
    inside = np.zeros(len(index), bool)
    counts: dict[tuple[str, bool], int] = {}
    for track in tracks:
        there = (cloud.time[index] >= track.times[0] - 0.1) & (cloud.time[index] <= track.times[-1] + 0.1)
        near = np.flatnonzero(there if track.moving else np.ones(len(index), bool))
        poses = track.at(cloud.time[index[near]])
        c, s = np.cos(poses[:, 3]), np.sin(poses[:, 3])
        offset = cloud.xyz[index[near], :2] - poses[:, :2]
        u, v = offset[:, 0] * c + offset[:, 1] * s, offset[:, 1] * c - offset[:, 0] * s
        own = (np.abs(u) < track.size[0] / 2 + 0.1) & (np.abs(v) < track.size[1] / 2 + 0.1)
        inside[near[own]] = True
        counts[track.category, track.moving] = counts.get((track.category, track.moving), 0) + int(own.sum())
    assert inside.mean() > 0.99
    assert min(counts.values()) > 10, counts
