"""A drive without pictures: points along a road, seen in directions with noise, followed without error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.types import F64, Bools, Camera, GpsTrack
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.geometry import exp_so3, rigid
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trackers import Tracks

INSIDE = 7.815
"""Of chi-square with three degrees of freedom: where 95 % are."""
CAMERA_TO_WORLD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along +x, z up


def drive(
    seconds: float, *, fps: float = 10.0, speed: float = 10.0, turn: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) and poses (T, 4, 4) of a camera 2 m above a winding road; it does not move in the first second."""
    times = np.arange(0, seconds, 1 / fps)
    rate = np.clip(times - 1, 0, 1) * speed
    heading = np.cumsum(turn * np.sin(times / 3) * (rate > 0)) / fps * 3
    step = rate / fps
    xy = np.cumsum(np.stack([np.cos(heading) * step, np.sin(heading) * step], axis=1), axis=0)
    poses = [
        rigid(exp_so3([0, 0, h]) @ CAMERA_TO_WORLD, np.array([x, y, 2.0]))
        for h, (x, y) in zip(heading, xy, strict=True)
    ]
    return times, np.stack(poses)


def scatter(poses: np.ndarray, count: int = 6000, seed: int = 0) -> np.ndarray:
    """(P, 3) points beside and above a path."""
    rng = np.random.default_rng(seed)
    along = poses[rng.integers(0, len(poses), count), :3, 3]
    away = rng.uniform(5, 25, count) * rng.choice([-1, 1], count)
    around = rng.uniform(0, 2 * np.pi, count)
    return along + np.stack([away * np.cos(around), away * np.sin(around), rng.uniform(-2, 8, count)], axis=1)


class Follower:
    """Tracker of known points; `hide(frame, points)` returns which are hidden, and how others are displaced."""

    def __init__(
        self,
        poses: np.ndarray,
        points: np.ndarray,
        *,
        count: int = 300,
        noise: float = np.radians(0.03),
        hide: Callable[[int, np.ndarray], np.ndarray] | None = None,
        seed: int = 0,
    ) -> None:
        self.poses, self.points, self.count, self.noise, self.hide = poses, points, count, noise, hide
        self.tracks = Tracks()
        self.images: list[np.ndarray] = [np.zeros((64, 64), np.uint8)]
        self._rng, self._frame, self._given, self._point = np.random.default_rng(seed), -1, 0, np.zeros(0, np.int64)

    def _seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions of points, and which are seen."""
        pose = self.poses[self._frame]
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        far = np.linalg.norm(local, axis=1)
        bearing = local / far[:, None] + self._rng.normal(0, self.noise, local.shape)
        seen = (far < 40) & (far > 1)
        return bearing / np.linalg.norm(bearing, axis=1, keepdims=True), seen

    def track(self, grey: np.ndarray, expected: np.ndarray | None = None) -> float:
        self._frame += 1
        of = self._point[self.tracks.ids] if len(self.tracks) else np.zeros(0, np.int64)
        bearing, seen = self._seen(self.points[of])
        if self.hide is not None:
            seen &= ~self.hide(self._frame, self.points[of])
        self.tracks = Tracks(self.tracks.ids[seen], bearing[seen])
        return 1.0

    def drop(self, ids: np.ndarray) -> None:
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        bearing, seen = self._seen(self.points)
        if self.hide is not None:
            seen &= ~self.hide(self._frame, self.points)
        seen[self._point[self.tracks.ids]] = False
        room = max(0, self.count - len(self.tracks))
        chosen = self._rng.permutation(np.flatnonzero(seen))[:room]
        ids = np.arange(self._given, self._given + len(chosen))
        self._given += len(chosen)
        self._point = np.concatenate([self._point, chosen])
        self.tracks = Tracks(
            np.concatenate([self.tracks.ids, ids]), np.concatenate([self.tracks.bearing, bearing[chosen]])
        )
        return len(chosen)


class PerspectiveFollower(Follower):
    """Follower with the field of view of a perspective camera: 45 degrees about its axis."""

    def _seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bearing, seen = super()._seen(points)
        return bearing, seen & (bearing[:, 2] > 0.7)


def gps_of(times: np.ndarray, poses: np.ndarray, sigma: float = 0.0, seed: int = 0) -> GpsTrack:
    """Fixes at every pose."""
    noise = np.random.default_rng(seed).normal(0, sigma, (len(times), 3)) if sigma else 0.0
    return GpsTrack(times, poses[:, :3, 3] + noise)


def run(
    times: np.ndarray,
    follower: Follower,
    *,
    gps: GpsTrack | None = None,
    warn: Callable[[str], None] = lambda _: None,
    keep: bool = False,
    **params: Any,
) -> Odometry:
    """Odometry over a drive."""

    camera = Camera("equirectangular", 2048, 1024)
    odometry = Odometry(camera, OdometryParams(**params), tracker=follower, gps=gps, warn=warn, keep=keep)
    for time in times:
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
    return odometry


def position_errors(odometry: Odometry, poses: F64) -> F64:
    """(T, 3) errors of positions against poses (T, 4, 4) at 10 Hz that begin where the odometry's do, at its scale."""
    first, second = odometry.map.keyframes[:2]
    a, b = (poses[round(10 * k.time)] for k in (first, second))
    unit = np.linalg.norm(second.T_world_cam[:3, 3] - first.T_world_cam[:3, 3]) / np.linalg.norm(b[:3, 3] - a[:3, 3])
    truth = np.linalg.inv(a) @ poses
    truth[:, :3, 3] *= unit
    found = np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed])
    return found - (first.T_world_cam @ truth)[:, :3, 3]


def inside(errors: F64, covariance: F64) -> Bools:
    """(T,) bool, True where the 95 % ellipsoid contains the error."""
    return np.einsum("ti,tij,tj->t", errors, np.linalg.inv(covariance[:, :3, :3]), errors) < INSIDE


def drifting_turn() -> tuple[F64, F64, F64]:
    """Times, true and estimated positions of 52 m with a turn of 98 degrees, whose scale drifts as in KITTI."""
    heading = np.radians(98) / (1 + np.exp(-(np.arange(51) - 25) / 4))
    step = 1.02 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1)
    drift = np.interp(np.arange(51), [5, 25, 45], [0.885, 1.001, 1.048])
    places = [np.vstack([np.zeros(3), np.cumsum(s[1:], axis=0)]) for s in (step, step * drift[:, None])]
    return np.arange(51) / 10, places[0], places[1]


def ate(found: F64, truth: F64, *, scaled: bool = True) -> float:
    """Absolute trajectory error: RMS distance in metres of positions (N, 3) after alignment, rigid if not `scaled`."""
    off = umeyama(found, truth, scaled=scaled).apply(found) - truth
    return float(np.sqrt((off**2).sum(axis=1).mean()))


LENS = Camera("pinhole", 1240, 1240, 700.0, 700.0, 619.5, 619.5)


def odometry_with_wrong_intrinsics(given: Camera, seed: int, turn: float = 0.3) -> Odometry:
    """Odometry in a turn with a camera whose intrinsics are `LENS`, given the intrinsics `given`."""

    class Mistaken(PerspectiveFollower):
        def _seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            bearing, seen = super()._seen(points)
            return unproject(given, project_exactly(LENS, bearing)[0]), seen

    times, poses = drive(8, turn=turn)
    odometry = Odometry(given, OdometryParams(), tracker=Mistaken(poses, scatter(poses, 12000, seed), seed=seed))
    for time in times:
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
    return odometry
