"""A simulated drive along a street and back, scanned by a lidar, whose INS drifts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.slam.geometry import exp_so3, inverse

PERIOD_S, SPACING_M, HEIGHT_M = 0.1, 1.2, 1.8
LENGTH_M, TURN_RADIUS_M = 36.0, 1.5
WALLS_M = (-7.0, 9.0)
PIER_SPACING_M, PIER_WIDTH_M, PIER_DEPTH_M = 9.0, 2.5, 1.0
ROWS, COLUMNS, NOISE_M, RANGE_M = 18, 300, 0.01, 45.0


@dataclass(frozen=True)
class Passes:
    """A drive: `times` (N,), scanner poses `truth` and `ins` (N, 4, 4), and `second` (N,), whether of the way back."""

    times: F64
    truth: F64
    ins: F64
    second: Bools

    def sweep(self, i: int) -> F64:
        """(M, 3) points of a sweep in scanner axes."""
        columns = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
        azimuth, elevation = (a.ravel() for a in np.meshgrid(columns, np.radians(np.linspace(-24, 12, ROWS))))
        flat = np.cos(elevation)
        ray = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
        T = self.truth[i]
        far = _street(T[:3, 3], ray @ T[:3, :3].T) + np.random.default_rng(i).normal(0, NOISE_M, len(ray))
        return (ray * far[:, None])[far < RANGE_M]

    def gap(self, poses: F64) -> F64:
        """(K,) metres between the surfaces of both passes, by poses (N, 4, 4), for places that both have scanned.

        Root mean square over the points of a sweep within 15 m.
        """
        first, back = np.flatnonzero(~self.second), np.flatnonzero(self.second)
        out = []
        for j in back[::4]:
            distance = np.linalg.norm(self.truth[first, :3, 3] - self.truth[j, :3, 3], axis=1)
            i = first[distance.argmin()]
            if distance.min() > 6:
                continue
            points = self.sweep(j)
            points = points[np.linalg.norm(points, axis=1) < 15]
            wrong = inverse(inverse(self.truth[i]) @ self.truth[j]) @ inverse(poses[i]) @ poses[j]
            moved = points @ wrong[:3, :3].T + wrong[:3, 3] - points
            out.append(float(np.sqrt((moved**2).sum(axis=1).mean())))
        return np.array(out)

    def offset(self, poses: F64) -> float:
        """Distance of the mean position of poses (N, 4, 4) from the truth, metres."""
        return float(np.linalg.norm((poses - self.truth)[:, :3, 3].mean(axis=0)))

    def write(self, folder: Path, poses: F64, count: int | None = None) -> None:
        """Write sweeps/ (.bin, named by their times) and poses.csv with `count` poses."""
        (folder / "sweeps").mkdir(parents=True)
        for i in range(len(self.times))[:count]:
            xyz: F32 = self.sweep(i).astype(np.float32)
            np.column_stack([xyz, np.full(len(xyz), 0.5, np.float32)]).tofile(
                folder / "sweeps" / f"{self.times[i]:.3f}.bin"
            )
        path = Trajectory(self.times[:count], poses[:count, :3, 3], poses[:count, :3, :3])
        trajectory_io.write(folder / "poses.csv", path)

    def assemble(
        self, folder: Path, poses: F64, *, clock_s: float = 0.0, timed: bool = True, frame: Frame | None = None
    ) -> None:
        """Write cloud.laz, merged by local poses (N, 4, 4), and path.csv, positions without rotations."""
        parts = [(self.sweep(i), poses[i], self.times[i]) for i in range(len(self.times))]
        xyz = np.concatenate([points @ T[:3, :3].T + T[:3, 3] for points, T, _ in parts]).astype(np.float32)
        times = np.concatenate([np.full(len(points), time + clock_s) for points, _, time in parts])
        folder.mkdir(parents=True, exist_ok=True)
        intensity = np.arange(len(xyz)).astype(np.uint16)
        las.write(
            folder / "cloud.laz", PointCloud(frame or Frame(), xyz, time=times if timed else None, intensity=intensity)
        )
        trajectory_io.write(folder / "path.csv", Trajectory(self.times, poses[:, :3, 3]))


def passes(*, drift_m: float = 0.3, between_m: float = 0.2) -> Passes:
    """A drive whose INS drifts sideways by `drift_m` in 10 m, and by `between_m` between the two passes."""
    turn = np.pi * TURN_RADIUS_M
    along = np.arange(0, 2 * LENGTH_M + turn, SPACING_M, dtype=np.float64)
    angle = np.clip((along - LENGTH_M) / TURN_RADIUS_M, 0, np.pi)
    back = np.maximum(along - LENGTH_M - turn, 0)
    x = np.minimum(along, LENGTH_M) + TURN_RADIUS_M * np.sin(angle) - back
    y = TURN_RADIUS_M * (1 - np.cos(angle))
    truth = np.tile(np.eye(4), (len(along), 1, 1))
    truth[:, :3, :3] = exp_so3(np.stack([0 * angle, 0 * angle, angle], axis=1))
    truth[:, :3, 3] = np.stack([x, y, np.full(len(along), HEIGHT_M)], axis=1)
    ins = truth.copy()
    sideways = 0.5 * drift_m * np.sin(2 * np.pi * along / 20)
    ins[:, :3, 3] += truth[:, :3, 1] * sideways[:, None]
    changed = between_m * np.clip((along - LENGTH_M) / turn, 0, 1)
    ins[:, :3, 3] += changed[:, None] * [0.3, 0.9, 0.3]
    return Passes(PERIOD_S * np.arange(len(along), dtype=np.float64), truth, ins, along > LENGTH_M + turn)


def _street(origin: F64, ray: F64) -> F64:
    """(N,) metres from a position (3,) along directions (N, 3) to ground, walls and the piers before them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        far = [-origin[2] / ray[:, 2]]
        low, high = WALLS_M
        for side, inner in ((low, low + PIER_DEPTH_M), (high, high - PIER_DEPTH_M)):
            far.append((side - origin[1]) / ray[:, 1])
            starts = np.arange(-5 * PIER_SPACING_M, LENGTH_M + 5 * PIER_SPACING_M, PIER_SPACING_M)
            front = (inner - origin[1]) / ray[:, 1]
            phase = (origin[0] + front * ray[:, 0] - starts[0]) % PIER_SPACING_M
            far.append(np.where(phase < PIER_WIDTH_M, front, np.inf))
            for x in (*starts, *(starts + PIER_WIDTH_M)):
                face = (x - origin[0]) / ray[:, 0]
                y = origin[1] + face * ray[:, 1]
                far.append(np.where((y > min(side, inner)) & (y < max(side, inner)), face, np.inf))
    hits = np.stack(far)
    hits[~(hits > 1e-6)] = np.inf
    return np.asarray(hits.min(axis=0))
