"""A simulated drive with the noisy measurements of a lidar, a camera and a GPS receiver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.slam.geometry import exp_so3, inverse
from scan2sim.slam.trajectory.fusion import Fused, GpsFixes, RelativeMotions, camera_motions, fuse
from tests.fakes.slam_drive import ate


@dataclass(frozen=True)
class Simulated:
    """Simulated sensors of a drive: scanner poses `truth` (N, 4, 4) at `times`, lidar steps, camera path, GPS."""

    times: F64
    truth: F64
    lidar: RelativeMotions
    camera: Trajectory
    T_camera_scanner: F64
    gps: F64

    @property
    def fixes(self) -> GpsFixes:
        """GPS positions as a factor."""
        return GpsFixes(self.gps, 0.3, 1.5, 60.0)

    def fused(self, *sensors: str) -> Fused:
        """Path fused from some of lidar, camera and gps."""
        return fuse(
            self.times,
            lidar=self.lidar if "lidar" in sensors else None,
            camera=camera_motions(self.camera, self.times) if "camera" in sensors else None,
            T_camera_scanner=self.T_camera_scanner,
            fixes=self.fixes if "gps" in sensors else None,
            first=self.truth[0],
        )

    def measure(self) -> dict[str, float]:
        """ATE of each sensor alone, and of all fused."""
        truth = self.truth[:, :3, 3]
        beside = (self.truth @ inverse(self.T_camera_scanner))[:, :3, 3]
        return {
            "lidar": ate(self.fused("lidar").trajectory.positions, truth, scaled=False),
            "visual": ate(self.camera.positions, beside),
            "gps": ate(self.gps, truth, scaled=False),
            "fused": ate(self.fused("lidar", "camera", "gps").trajectory.positions, truth, scaled=False),
        }


def simulated(
    seed: int,
    *,
    tunnel: tuple[int, int] = (100, 160),
    dark: tuple[int, int] = (250, 300),
    outliers: int = 40,
) -> Simulated:
    """A drive of 400 m in 40 s with sensors that fail in places.

    Args:
        tunnel: steps in which the lidar measures 0.3 of the motion, with a large covariance.
        dark: steps in which the camera's motion is extrapolated and marked unsure.
        outliers: number of GPS fixes out of 400 that are off by tens of metres; fifteen more in a row are off by 9 m.
    """
    rng, n = np.random.default_rng(seed), 400
    times: F64 = np.arange(n, dtype=np.float64) * 0.1
    heading = np.cumsum(rng.normal(0, 0.003, n) + 0.01 * np.sin(times / 5))
    truth = np.tile(np.eye(4), (n, 1, 1))
    truth[:, :3, :3] = exp_so3(np.outer(heading, [0, 0, 1]))
    ahead = np.stack([np.cos(heading), np.sin(heading), 0.01 * np.sin(times)], axis=1)
    truth[1:, :3, 3] = np.cumsum(ahead, axis=0)[:-1]
    T = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.4], [1, 0, 0, -0.3], [0, 0, 0, 1]])

    step = inverse(truth[:-1]) @ truth[1:]
    sigma = np.repeat([[0.02, 0.01, 0.01, 0.001, 0.001, 0.001]], n - 1, axis=0)
    error = rng.normal(size=(n - 1, 6)) * sigma
    step[:, :3, 3] += error[:, :3]
    step[:, :3, :3] = step[:, :3, :3] @ exp_so3(error[:, 3:])
    inside = slice(*tunnel)
    step[inside, 0, 3] *= 0.3
    sigma[inside, 0] = np.sqrt(tunnel[1] - tunnel[0])
    sure = np.ones(n - 1, bool)
    sure[inside] = False
    lidar_motions = RelativeMotions(step, sigma[:, :, None] ** 2 * np.eye(6), sure)

    camera = truth @ inverse(T)
    seen = inverse(camera[:-1]) @ camera[1:]
    size = 0.7 * np.exp(np.cumsum(rng.normal(0, 0.006, n - 1))) * (1 + rng.normal(0, 0.01, n - 1))
    seen[:, :3, 3] = size[:, None] * seen[:, :3, 3] + rng.normal(0, 0.005, (n - 1, 3))
    seen[:, :3, :3] = seen[:, :3, :3] @ exp_so3(rng.normal(0, 0.0007, (n - 1, 3)))
    seen[slice(*dark)] = seen[dark[0]]
    path = [camera[0]]
    for one in seen:
        path.append(path[-1] @ one)
    unsure = np.zeros(n, bool)
    unsure[dark[0] + 1 : dark[1] + 1] = True
    poses = np.array(path)

    keep = np.exp(-0.1 / 60)
    slow = rng.normal(0, 1.5, (n, 3))
    for i in range(1, n):
        slow[i] = keep * slow[i - 1] + np.sqrt(1 - keep**2) * slow[i]
    gps = truth[:, :3, 3] + slow + rng.normal(0, 0.3, (n, 3))
    gps[rng.choice(n, outliers, replace=False)] += rng.normal(0, 30, (outliers, 3))
    if outliers:
        gps[330:345] += [8, 5, 0]
    return Simulated(times, truth, lidar_motions, Trajectory(times, poses[:, :3, 3], poses[:, :3, :3], unsure), T, gps)
