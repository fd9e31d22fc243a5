"""Global adjustment compared with odometry alone: which path is better, and which one cross-validation keeps."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.slam.frames import Sequence, odometry, positions
from bench.slam.world import DRIVE as STREET
from bench.slam.world import prepare
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.importers import kitti_raw
from scan2sim.slam.global_map.global_adjustment import bundle_adjust
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import update_map
from scan2sim.slam.mapping.cross_validation import compare_paths
from scan2sim.slam.odometry.odometry import Odometry
from scan2sim.slam.video import open_video
from tests.fakes.slam_drive import Follower, PerspectiveFollower, ate, drive, run, scatter

DRIVES, SECONDS = 20, 20.0
FEATURE_COUNTS = 640, 700, 760


class Outcome(NamedTuple):
    """ATE (m) of odometry alone and of the adjusted path, and gain of the latter on held-out observations."""

    alone: float
    adjusted: float
    gain: float

    @property
    def kept(self) -> float:
        """ATE of the path that is kept."""
        return self.adjusted if self.gain > 0 else self.alone

    @property
    def best(self) -> float:
        """ATE of the better path."""
        return min(self.alone, self.adjusted)


def outcome(found: Odometry, error: Callable[[F64], float]) -> Outcome:
    """Adjust an odometry that has kept its tracks; `error` returns the error (m) of positions (T, 3)."""
    mapped = MapCheckpoint.of(found, [])
    alone, before = error(positions(found)), np.stack([k.T_world_cam for k in mapped.map.keyframes])
    new = bundle_adjust(mapped)
    comparison = compare_paths(mapped.map, before, new.poses)
    update_map(mapped, new.known, new.poses, new.xyz)
    return Outcome(alone, error(positions(found)), comparison.gain)


def street() -> Sequence:
    """KITTI 0009 with the registered positions of its sweeps."""
    drive = next(p for p in STREET.iterdir() if p.is_dir())
    with tempfile.TemporaryDirectory() as folder:
        T_cam_velo = np.loadtxt(prepare(Path(folder), drive)["extrinsics"])
    P = kitti_raw.calibration_entry(drive, "calib_cam_to_cam.txt", "P_rect_02", 12).reshape(3, 4)
    frames = next(drive.glob("*_sync")) / "image_02" / "data"
    video = open_video(frames)
    poses = np.loadtxt(next(STREET.glob("T_velo0_velo_icp*"))).reshape(-1, 3, 4)
    camera = -T_cam_velo[:, :3].T @ T_cam_velo[:, 3]
    return Sequence(
        "KITTI 0009", frames, Camera("pinhole", video.width, video.height, P[0, 0], P[1, 1], P[0, 2], P[1, 2]),
        poses[:, :, :3] @ camera + poses[:, :, 3],
    )  # fmt: skip


def simulated() -> list[Outcome]:
    """Simulated drives without images: half with a 360 camera, half perspective."""
    out = []
    for seed in range(DRIVES):
        times, poses = drive(SECONDS, turn=0.05 * (1 + seed % 4))
        kind, count = ((Follower, 6000), (PerspectiveFollower, 20000))[seed % 2]
        follower = kind(poses, scatter(poses, count, seed), seed=seed)
        found = run(times, follower, keep=True, parallax=(3.0, 1.0)[seed % 2])
        out.append(outcome(found, partial(ate, truth=poses[:, :3, 3])))
    return out


def chosen(sequences: Iterable[Sequence]) -> dict[str, float | None]:
    """How often the better path is kept: on frames with three numbers of features, and on simulated drives."""
    sequences = [*sequences, *([street()] if STREET.is_dir() else [])]
    known = {
        one.name: [outcome(odometry(one, keep=True, count=n)[0], one.ate) for n in FEATURE_COUNTS] for one in sequences
    } | {f"{DRIVES} simulated drives": simulated()}
    for name, outcomes in known.items():
        table = np.array([(one.alone, one.adjusted, one.kept, one.best) for one in outcomes])
        right = int(sum(one.kept == one.best for one in outcomes))
        print(
            f"{name}: alone {100 * table[:, 0].mean():.2f} cm, adjusted {100 * table[:, 1].mean():.2f}, kept "
            f"{100 * table[:, 2].mean():.2f}, the better one {100 * table[:, 3].mean():.2f}; kept on {right} of "
            f"{len(outcomes)}; gain on held-out observations {', '.join(f'{one.gain:.4f}' for one in outcomes)}",
            flush=True,
        )
    every = [one for outcomes in known.values() for one in outcomes]
    return {
        "adjust_right": float(np.mean([one.kept == one.best for one in every])),
        "adjust_over_best": float(np.exp(np.mean([np.log(one.kept / one.best) for one in every]))),
    }
