"""Lidar odometry: each sweep is matched to what the sweeps before it have seen, by kiss-icp; and how sure that is.

KISS-ICP (Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023) tells no covariance: a tunnel along
which it slides looks to it like any street. How much a sweep's surfaces hold each direction is seen of their normals:
what only their noise holds, nothing does (cf. Tuna et al., "X-ICP", T-RO 2023).
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

REACH, VOXEL = 100.0, 1.0
"""Metres: of points that are matched, and of a voxel of the map that they are matched to; kiss-icp's own."""
PAIRED = 2000
"""Points of a sweep that are held against the sweep before."""
NEIGHBOURS = 8
"""Points that a normal is taken from."""
FLAT = 0.1
"""Of these, the smallest spread over the middle one: what is less flat has no normal."""
SURFACE = 0.02
"""Metres by which flat points scatter about their surfaces at least."""
BLUR = 0.015
"""Of the points: so much of a direction is held by the noise of normals alone (7 degrees)."""
ALIKE = 20.0
"""Points of a sweep that err together."""
LEAST = (0.01, 0.001)
"""Metres and radians by which the best match of two sweeps may be off."""
SPEED, TURN = 10.0, 0.3
"""Metres and radians a second by which a match may be off where nothing holds it: it is carried on, or stands still."""
OVERLAP = 0.3
"""Share of a sweep's points that lie near one of the sweep before: with less, they show different places."""
FIRST, ROUNDS = 6, 2
"""Sweeps that the velocity at the beginning is found of, and how often."""
SURE = 0.1
"""Metres, one standard deviation along the worst direction, from which on a match is unsure."""


class Measured(NamedTuple):
    """A sweep of a `time` (s): points `xyz` (N, 3) in the scanner's axes, measured `ages` (N,) seconds after it."""

    time: float
    xyz: F32
    ages: F64


@dataclass(frozen=True)
class Matched:
    """Sweeps matched one to the other.

    Attributes:
        times: (N,) seconds; of sweeps that have none, as many a second as is usual.
        poses: (N, 4, 4) each scanner's to the first's axes.
        covariance: (N - 1, 6, 6) of the step from each sweep to the next: position (m) and rotation (rad) in the next
            one's axes.
        overlap: (N - 1,) share of a sweep's points that lie near one of the sweep before.
    """

    times: F64
    poses: F64
    covariance: F64
    overlap: F64

    @property
    def sure(self) -> Bools:
        """(N - 1,) which steps the sweeps' surfaces hold."""
        return (worst(self.covariance) < SURE) & (self.overlap > OVERLAP)

    def save(self, path: Path) -> Path:
        """Write as .npz."""
        with open(path, "wb") as file:
            np.savez(file, **self.__dict__)
        return path

    @classmethod
    def load(cls, path: Path) -> Matched:
        """Read what `save` wrote.

        Raises:
            InputError: it is something else.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls(**{name: data[name] for name in data.files})
        except (OSError, ValueError, TypeError) as error:
            raise InputError(path, f"holds no matched sweeps ({error})", "Match them again") from error


def worst(covariance: F64) -> F64:
    """(N,) metres, one standard deviation along the worst direction, of (N, 6, 6)."""
    return np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1])


class LidarOdometry:
    """Matches sweep after sweep; `STATE` is what it goes on from where it was interrupted.

    Args:
        near: metres from the scanner: nearer returns, those of the car itself, match nothing.
        velocity: (6,) metres and radians a second, in the scanner's axes, of the first sweeps (`begun`).
    """

    STATE = ("times", "poses", "covariance", "overlap", "surprises", "places", "before", "first", "start")

    def __init__(self, near: float = 1.0, velocity: F64 | None = None) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
        from kiss_icp.kiss_icp import KissICP

        self.first = np.zeros(6) if velocity is None else velocity
        self._icp = KissICP(
            KISSConfig(
                data=DataConfig(max_range=REACH, min_range=near, deskew=False),
                mapping=MappingConfig(voxel_size=VOXEL),
                registration=RegistrationConfig(max_num_threads=1),  # with several, sums differ from run to run
            )
        )
        self.times: list[float] = []
        self.poses: list[F64] = []
        self.covariance: list[F64] = []
        self.overlap: list[float] = []
        self._surprises: list[F64] = []
        self.start: F64 = np.eye(4)
        """(4, 4) where the first sweep is foreseen in the map."""
        self.before: F64 = np.zeros((0, 3))
        """(P, 3) points of the last sweep, thinned, in the map's axes."""

    @property
    def places(self) -> F64:
        """(P, 3) the map that sweeps are matched to."""
        return np.asarray(self._icp.local_map.point_cloud(), np.float64).reshape(-1, 3)

    @places.setter
    def places(self, points: F64) -> None:
        self._icp.local_map.clear()
        self._icp.local_map.add_points(points)

    @property
    def surprises(self) -> list[F64]:
        """By how much each match differed from what was foreseen, (4, 4) each: the search is as wide as they are."""
        return self._surprises

    @surprises.setter
    def surprises(self, given: list[F64]) -> None:
        for one in given:
            self._icp.adaptive_threshold.update_model_deviation(one)
        self._surprises = given

    def add(self, time: float, xyz: F32, ages: F64) -> None:
        """Match a sweep.

        Args:
            time: seconds, later than the last one's.
            xyz: (N, 3) in the scanner's axes.
            ages: (N,) seconds after `time` at which they were measured: they are brought to that moment by the motion
                so far.
        """
        velocity = self.velocity
        seconds = time - self.times[-1] if self.times else 0.0
        points = carried(velocity, ages, xyz.astype(np.float64))
        self._icp.last_pose = self.poses[-1] if self.poses else self.start
        self._icp.last_delta = step(velocity, np.array([seconds]))[0]
        foreseen = self._icp.last_pose @ self._icp.last_delta
        _, source = self._icp.register_frame(points, np.zeros(0))
        pose = np.asarray(self._icp.last_pose) if len(source) else foreseen
        self._surprises.append(np.linalg.inv(foreseen) @ pose)
        source = np.asarray(source).reshape(-1, 3)
        if self.poses:
            covariance, overlap = held(source, pose, self.before, seconds)
            self.covariance.append(covariance)
            self.overlap.append(overlap)
        self.times.append(time)
        self.poses.append(pose)
        self.before = _thinned(points) @ pose[:3, :3].T + pose[:3, 3]

    def seen(self, points: F64, pose: F64) -> None:
        """Add points (N, 3) that a scanner saw from a pose (4, 4) to the map."""
        self._icp.local_map.update(_thinned(points), pose)

    def matched(self) -> Matched:
        """All so far, one at least."""
        return Matched(
            np.array(self.times), inverse(self.poses[0]) @ np.array(self.poses),
            np.array(self.covariance).reshape(-1, 6, 6), np.array(self.overlap),
        )  # fmt: skip

    @property
    def velocity(self) -> F64:
        """(6,) metres and radians a second, in the scanner's axes, of the last step."""
        if len(self.poses) < 2:
            return self.first
        last = inverse(self.poses[-2]) @ self.poses[-1]
        seconds = self.times[-1] - self.times[-2]
        return np.concatenate([last[:3, 3], log_so3(last[:3, :3])]) / seconds


def begun(first: Sequence[Measured], near: float) -> LidarOdometry:
    """An odometry that is to be given these sweeps, the first few, and what follows: it knows their velocity and place.

    Begun as if the scanner stood, the first matches are drawn back, and the map is smeared for good. So the first few
    are matched in rounds, each with the velocity of the one before, and the later ones of them are the first map.
    """
    velocity, half = np.zeros(6), len(first) // 2
    for _ in range(ROUNDS):
        trial = LidarOdometry(near, velocity)
        for sweep in first:
            trial.add(*sweep)
        velocity = trial.velocity
    new = LidarOdometry(near, velocity)
    for sweep, pose in list(zip(first, trial.poses, strict=True))[half:]:
        new.seen(carried(velocity, sweep.ages, sweep.xyz.astype(np.float64)), pose)
    new.start = trial.poses[half] @ step(velocity, np.array([first[0].time - first[half].time]))[0]
    new.surprises = trial.surprises
    return new


def step(velocity: F64, seconds: F64) -> F64:
    """(N, 4, 4) motions at an even velocity (6,) over so many seconds (N,)."""
    out = np.tile(np.eye(4), (len(seconds), 1, 1))
    out[:, :3, :3] = exp_so3(seconds[:, None] * velocity[3:])
    out[:, :3, 3] = seconds[:, None] * velocity[:3]
    return out


def carried(velocity: F64, ages: F64, xyz: F64) -> F64:
    """(N, 3) points where they are seen from at the sweep's own moment, measured so many seconds after it."""
    if not velocity.any() or not ages.any():
        return xyz
    T = step(velocity, ages)
    return np.einsum("nij,nj->ni", T[:, :3, :3], xyz) + T[:, :3, 3]


def held(points: F64, pose: F64, before: F64, seconds: float) -> tuple[F64, float]:
    """How well the surfaces that two sweeps share hold the second one's pose.

    Args:
        points: (N, 3) of the second, in its axes.
        pose: (4, 4) its place in the world.
        before: (P, 3) of the first, in the world.
        seconds: between them.

    Returns:
        (6, 6) covariance of position and rotation in the second's axes, and the share of its points that lie near one
        of the first's.
    """
    free = np.repeat([(SPEED * seconds) ** 2, (TURN * seconds) ** 2], 3)
    least = np.repeat([LEAST[0] ** 2, LEAST[1] ** 2], 3)
    pairs, overlap = _pairs(points, pose, before)
    if not len(pairs.off):
        return np.diag(free), overlap
    arm = float(np.linalg.norm(pairs.place, axis=1).mean())
    J = np.concatenate([pairs.normal, np.cross(pairs.place, pairs.normal) / arm], axis=1)
    sigma = max(SURFACE, 1.4826 * float(np.median(np.abs(pairs.off))))
    values, vectors = np.linalg.eigh(J.T @ J)
    known = np.maximum(values - BLUR * len(J), 0) / (ALIKE * sigma**2)
    units = np.repeat([1.0, 1 / arm], 3)  # of J's columns
    information = (vectors / units[:, None]) @ np.diag(known) @ (vectors / units[:, None]).T
    return np.linalg.inv(information + np.diag(1 / free)) + np.diag(least), overlap


@dataclass(frozen=True)
class _Pairs:
    """Points of a sweep on surfaces of the one before: `place`, `normal` (K, 3) in its axes, metres `off` (K,)."""

    place: F64
    normal: F64
    off: F64


def _pairs(points: F64, pose: F64, before: F64) -> tuple[_Pairs, float]:
    """Pairs, and the share of points that have something near."""
    from scipy.spatial import cKDTree

    none = _Pairs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    points = points[:: max(1, len(points) // PAIRED)]
    if not len(points) or len(before) < NEIGHBOURS:
        return none, 0.0
    world = points @ pose[:3, :3].T + pose[:3, 3]
    gap, near = cKDTree(before).query(world, NEIGHBOURS, distance_upper_bound=2 * VOXEL)
    close = gap[:, 0] < VOXEL
    overlap = float(close.mean())
    close &= np.isfinite(gap[:, -1])
    if not close.any():
        return none, overlap
    around = before[near[close]]
    centre = around.mean(axis=1)
    spread, axes = np.linalg.eigh(np.einsum("knj,knl->kjl", around - centre[:, None], around - centre[:, None]))
    flat = spread[:, 0] < FLAT**2 * spread[:, 1]
    normal, off = axes[flat, :, 0], np.einsum("kj,kj->k", axes[flat, :, 0], (world[close] - centre)[flat])
    return _Pairs(points[close][flat], normal @ pose[:3, :3], off), overlap


def _thinned(points: F64) -> F64:
    """One point in half a voxel, as kiss-icp thins what it adds to its map."""
    from kiss_icp.voxelization import voxel_down_sample

    return np.asarray(voxel_down_sample(points, VOXEL * 0.5)).reshape(-1, 3)
