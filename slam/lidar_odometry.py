"""Lidar odometry: registers each sweep with the map of previous sweeps, by kiss-icp, and estimates its covariance.

KISS-ICP (Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023) estimates no covariance: it slides
along a tunnel without noticing. How well the surfaces of a sweep constrain each direction follows from their normals;
directions constrained only by the normals' noise count as unconstrained (degeneracy detection; cf. Tuna et al.,
"X-ICP", T-RO 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, Bools
from scan2sim.slam.geometry import exp_so3, inverse, log_so3


@dataclass(frozen=True)
class RegistrationModel:
    """Limits and noise model of the registration of sweeps."""

    max_range_m: float = 100.0
    """Range of the registered points; kiss-icp's default."""
    voxel_m: float = 1.0
    """Voxel size of the map; kiss-icp's default."""
    pairs_max: int = 2000
    """Number of points per sweep that are compared with the previous sweep."""
    normal_neighbours: int = 8
    """Points that a normal is estimated from."""
    flatness_max: float = 0.1
    """Ratio of the smallest to the middle standard deviation of these points, above which there is no normal."""
    surface_sigma_min_m: float = 0.02
    """Least scatter of points about their surface."""
    normal_noise_share: float = 0.015
    """Share of the points' information on a direction that comes from noise of the normals alone (7 degrees)."""
    correlated_points: float = 20.0
    """Number of points of a sweep that share one error."""
    sigma_min: tuple[float, float] = (0.01, 0.001)
    """Least standard deviation of the registration of two sweeps, metres and radians."""
    unconstrained_speed: float = 10.0
    """Standard deviation of a registration in an unconstrained direction, metres per second: the result is either
    extrapolated or does not move."""
    unconstrained_turn: float = 0.3
    """The same of a rotation, radians per second."""
    overlap_min: float = 0.3
    """Least share of a sweep's points near points of the previous one; below, they show different locations."""
    init_sweeps: int = 6
    """Number of sweeps from which the initial velocity is estimated."""
    init_rounds: int = 2
    """Number of rounds over these sweeps."""
    sure_sigma_max_m: float = 0.1
    """Standard deviation along the worst direction, above which a registration is unsure."""


MODEL = RegistrationModel()


class Measured(NamedTuple):
    """A sweep at a `time` (s): points `xyz` (N, 3) in scanner axes, measured `ages` (N,) seconds after that time."""

    time: float
    xyz: F32
    ages: F64


@dataclass(frozen=True)
class MatchedSweeps:
    """Registered sweeps.

    Attributes:
        times: (N,) seconds; of sweeps without times, at the usual rate.
        poses: (N, 4, 4) scanner to the axes of the first sweep.
        covariance: (N - 1, 6, 6) of the motion from each sweep to the next: position (m) and rotation (rad) in the
            axes of the next.
        overlap: (N - 1,) share of a sweep's points near points of the previous one.
    """

    times: F64
    poses: F64
    covariance: F64
    overlap: F64

    @property
    def sure(self) -> Bools:
        """(N - 1,) motions that are constrained in all directions."""
        return (worst_sigma(self.covariance) < MODEL.sure_sigma_max_m) & (self.overlap > MODEL.overlap_min)

    def save(self, path: Path) -> Path:
        """Write an .npz file; returns its path."""
        with open(path, "wb") as file:
            np.savez(file, **self.__dict__)
        return path

    @classmethod
    def load(cls, path: Path) -> MatchedSweeps:
        """Read a file written by `save`.

        Raises:
            InputError: the file is damaged, or of another kind.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls(**{name: data[name] for name in data.files})
        except (OSError, ValueError, TypeError) as error:
            raise InputError(path, f"is no file of matched sweeps ({error})", "Match the sweeps again") from error


def worst_sigma(covariance: F64) -> F64:
    """(N,) standard deviation of the position along its worst direction, metres, of covariances (N, 6, 6)."""
    return np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1])


class LidarOdometry:
    """Registers sweeps in order; `STATE` is saved in checkpoints, from which an interrupted run resumes.

    Args:
        min_range: metres; nearer returns, those of the car itself, are ignored.
        velocity: (6,) initial velocity, metres and radians per second in scanner axes (see `initialized_odometry`).
    """

    STATE = (
        "times", "poses", "covariance", "overlap", "deviations", "map_points", "last_points", "initial_velocity",
        "start",
    )  # fmt: skip

    def __init__(self, min_range: float = 1.0, velocity: F64 | None = None) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
        from kiss_icp.kiss_icp import KissICP

        self.initial_velocity = np.zeros(6) if velocity is None else velocity
        self._icp = KissICP(
            KISSConfig(
                data=DataConfig(max_range=MODEL.max_range_m, min_range=min_range, deskew=False),
                mapping=MappingConfig(voxel_size=MODEL.voxel_m),
                registration=RegistrationConfig(max_num_threads=1),  # several threads aren't deterministic
            )
        )
        self.times: list[float] = []
        self.poses: list[F64] = []
        self.covariance: list[F64] = []
        self.overlap: list[float] = []
        self._deviations: list[F64] = []
        self.start: F64 = np.eye(4)
        """(4, 4) predicted pose of the first sweep in the map."""
        self.last_points: F64 = np.zeros((0, 3))
        """(P, 3) points of the last sweep, downsampled, in map axes."""

    @property
    def map_points(self) -> F64:
        """(P, 3) points of the map that sweeps are registered with."""
        return np.asarray(self._icp.local_map.point_cloud(), np.float64).reshape(-1, 3)

    @map_points.setter
    def map_points(self, points: F64) -> None:
        self._icp.local_map.clear()
        self._icp.local_map.add_points(points)

    @property
    def deviations(self) -> list[F64]:
        """Differences (4, 4) between predicted and registered poses; they determine kiss-icp's search distance."""
        return self._deviations

    @deviations.setter
    def deviations(self, deviations: list[F64]) -> None:
        for deviation in deviations:
            self._icp.adaptive_threshold.update_model_deviation(deviation)
        self._deviations = deviations

    def add(self, time: float, xyz: F32, ages: F64) -> None:
        """Register a sweep.

        Args:
            time: seconds, later than that of the last sweep.
            xyz: (N, 3) points in scanner axes.
            ages: (N,) seconds after `time` at which they were measured, to deskew them by the last velocity.
        """
        velocity = self.velocity
        seconds = time - self.times[-1] if self.times else 0.0
        points = deskewed(velocity, ages, xyz.astype(np.float64))
        self._icp.last_pose = self.poses[-1] if self.poses else self.start
        self._icp.last_delta = motion(velocity, np.array([seconds]))[0]
        predicted = self._icp.last_pose @ self._icp.last_delta
        _, source = self._icp.register_frame(points, np.zeros(0))
        pose = np.asarray(self._icp.last_pose) if len(source) else predicted
        self._deviations.append(np.linalg.inv(predicted) @ pose)
        source = np.asarray(source).reshape(-1, 3)
        if self.poses:
            covariance, overlap = registration_covariance(source, pose, self.last_points, seconds)
            self.covariance.append(covariance)
            self.overlap.append(overlap)
        self.times.append(time)
        self.poses.append(pose)
        self.last_points = _downsampled(points) @ pose[:3, :3].T + pose[:3, 3]

    def add_to_map(self, points: F64, pose: F64) -> None:
        """Add points (N, 3) in scanner axes to the map, from a scanner pose (4, 4)."""
        self._icp.local_map.update(_downsampled(points), pose)

    def matched(self) -> MatchedSweeps:
        """All sweeps registered so far; at least one."""
        return MatchedSweeps(
            np.array(self.times), inverse(self.poses[0]) @ np.array(self.poses),
            np.array(self.covariance).reshape(-1, 6, 6), np.array(self.overlap),
        )  # fmt: skip

    @property
    def velocity(self) -> F64:
        """(6,) velocity of the last motion, metres and radians per second in scanner axes."""
        if len(self.poses) < 2:
            return self.initial_velocity
        last = inverse(self.poses[-2]) @ self.poses[-1]
        seconds = self.times[-1] - self.times[-2]
        return np.concatenate([last[:3, 3], log_so3(last[:3, :3])]) / seconds


def initialized_odometry(first: Sequence[Measured], min_range: float) -> LidarOdometry:
    """An odometry with initial velocity, start pose and map; all sweeps, including `first`, must still be added to it.

    Started at zero velocity, the first registrations would lag behind, and blur the map permanently. So the first
    sweeps are registered in several rounds, each with the velocity of the previous round, and the later half of them
    becomes the initial map.
    """
    velocity, half = np.zeros(6), len(first) // 2
    for _ in range(MODEL.init_rounds):
        trial = LidarOdometry(min_range, velocity)
        for sweep in first:
            trial.add(*sweep)
        velocity = trial.velocity
    new = LidarOdometry(min_range, velocity)
    for sweep, pose in list(zip(first, trial.poses, strict=True))[half:]:
        new.add_to_map(deskewed(velocity, sweep.ages, sweep.xyz.astype(np.float64)), pose)
    new.start = trial.poses[half] @ motion(velocity, np.array([first[0].time - first[half].time]))[0]
    new.deviations = trial.deviations
    return new


def motion(velocity: F64, seconds: F64) -> F64:
    """(N, 4, 4) motions at constant velocity (6,) over times (N,) in seconds."""
    out = np.tile(np.eye(4), (len(seconds), 1, 1))
    out[:, :3, :3] = exp_so3(seconds[:, None] * velocity[3:])
    out[:, :3, 3] = seconds[:, None] * velocity[:3]
    return out


def deskewed(velocity: F64, ages: F64, xyz: F64) -> F64:
    """(N, 3) points in scanner axes at the sweep's time, from points measured `ages` (N,) seconds after it."""
    if not velocity.any() or not ages.any():
        return xyz
    T = motion(velocity, ages)
    return np.einsum("nij,nj->ni", T[:, :3, :3], xyz) + T[:, :3, 3]


def registration_covariance(points: F64, pose: F64, previous: F64, seconds: float) -> tuple[F64, float]:
    """How well the common surfaces of two sweeps constrain the second one's pose.

    Args:
        points: (N, 3) points of the second sweep, in its axes.
        pose: (4, 4) pose of the second sweep, scanner to world.
        previous: (P, 3) points of the first sweep, in the world.
        seconds: time between the sweeps.

    Returns:
        (6, 6) covariance of position and rotation in the second's axes, and the share of its points near points of the
        first.
    """
    unconstrained = np.repeat(
        [(MODEL.unconstrained_speed * seconds) ** 2, (MODEL.unconstrained_turn * seconds) ** 2], 3
    )
    least = np.repeat([MODEL.sigma_min[0] ** 2, MODEL.sigma_min[1] ** 2], 3)
    pairs, overlap = _pairs(points, pose, previous)
    if not len(pairs.distance):
        return np.diag(unconstrained), overlap
    arm = float(np.linalg.norm(pairs.point, axis=1).mean())
    J = np.concatenate([pairs.normal, np.cross(pairs.point, pairs.normal) / arm], axis=1)
    sigma = max(MODEL.surface_sigma_min_m, 1.4826 * float(np.median(np.abs(pairs.distance))))
    values, vectors = np.linalg.eigh(J.T @ J)
    known = np.maximum(values - MODEL.normal_noise_share * len(J), 0) / (MODEL.correlated_points * sigma**2)
    units = np.repeat([1.0, 1 / arm], 3)  # of J's columns
    information = (vectors / units[:, None]) @ np.diag(known) @ (vectors / units[:, None]).T
    return np.linalg.inv(information + np.diag(1 / unconstrained)) + np.diag(least), overlap


@dataclass(frozen=True)
class _Pairs:
    """Points of a sweep paired with surfaces of the previous one.

    Attributes:
        point, normal: (K, 3) in the sweep's axes.
        distance: (K,) signed distance from the surface, metres.
    """

    point: F64
    normal: F64
    distance: F64


def _pairs(points: F64, pose: F64, previous: F64) -> tuple[_Pairs, float]:
    """Pairs of points and surfaces, and the share of points near points of the previous sweep."""
    from scipy.spatial import cKDTree

    none = _Pairs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    points = points[:: max(1, len(points) // MODEL.pairs_max)]
    if not len(points) or len(previous) < MODEL.normal_neighbours:
        return none, 0.0
    world = points @ pose[:3, :3].T + pose[:3, 3]
    gap, nearest = cKDTree(previous).query(world, MODEL.normal_neighbours, distance_upper_bound=2 * MODEL.voxel_m)
    close = gap[:, 0] < MODEL.voxel_m
    overlap = float(close.mean())
    close &= np.isfinite(gap[:, -1])
    if not close.any():
        return none, overlap
    neighbours = previous[nearest[close]]
    centre = neighbours.mean(axis=1)
    offset = neighbours - centre[:, None]
    spread, axes = np.linalg.eigh(np.einsum("knj,knl->kjl", offset, offset))
    flat = spread[:, 0] < MODEL.flatness_max**2 * spread[:, 1]
    normal, distance = axes[flat, :, 0], np.einsum("kj,kj->k", axes[flat, :, 0], (world[close] - centre)[flat])
    return _Pairs(points[close][flat], normal @ pose[:3, :3], distance), overlap


def _downsampled(points: F64) -> F64:
    """One point per half voxel, as kiss-icp downsamples the points that it adds to its map."""
    from kiss_icp.voxelization import voxel_down_sample

    return np.asarray(voxel_down_sample(points, MODEL.voxel_m * 0.5)).reshape(-1, 3)
