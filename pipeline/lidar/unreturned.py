"""Rays of a spinning scanner that came back without a return, reconstructed from the gaps in its rings.

Files of sweeps contain returns only. Where they are stored ring after ring, azimuths within a ring ascend in steps of
the scanner's resolution, and a longer step is a gap: its rays met sky, glass, a wet road, or something out of range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools
from scan2sim.pipeline.lidar.sweeps import Sweeps


@dataclass(frozen=True)
class RingModel:
    """What the returns of a sweep look like if they are stored ring after ring."""

    min_rings: int = 3
    max_rings: int = 256
    min_returns_per_ring: int = 50
    """Mean number; fewer don't determine the step of azimuth."""
    start_bins: int = 180
    """Azimuths that are compared as the start of rings."""
    start_returns: int = 20
    """Returns on both sides of a start whose median elevations are compared."""
    max_backwards: float = 0.05
    """Largest share of steps within rings against the direction of rotation: noise of motion compensation."""
    max_step_rad: float = 0.05
    """Largest step of azimuth: 126 rays per turn."""


MODEL = RingModel()
NEAR_RAD = 0.02
"""Angle to an excluded return within which a ray is excluded, too: about six rays."""
BOX_STEP_M = 1.0
"""Interval at which rays are checked for excluded objects."""
NO_RINGS = "the returns of a sweep aren't in order of rings and azimuth, so rays without a return are unknown"


@dataclass(frozen=True)
class UnreturnedRays:
    """M rays without a return.

    Attributes:
        number: (M,) index of the sweep.
        origins: (M, 3) position of the scanner, local metres.
        directions: (M, 3) unit vectors, local axes.
        beside: (M, 2) recorded ranges of the returns on both sides of the gap in the ring, metres.
    """

    number: I32
    origins: F64
    directions: F64
    beside: F32

    def __len__(self) -> int:
        return len(self.number)

    def take(self, index: I64 | Bools) -> UnreturnedRays:
        """The rays that `index` selects."""
        return UnreturnedRays(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @staticmethod
    def join(parts: list[UnreturnedRays]) -> UnreturnedRays:
        """The rays of all parts."""
        none = UnreturnedRays(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2), np.float32))
        return UnreturnedRays(
            **{f.name: np.concatenate([getattr(one, f.name) for one in (none, *parts)]) for f in fields(none)}
        )


def unreturned_rays(sweeps: Sweeps, model: RingModel = MODEL) -> tuple[UnreturnedRays, str]:
    """Rays without a return of sweeps, in the order in which the scanner's files store them.

    Returns:
        The rays; and the reason if there are none because rings can't be found, or "".
    """
    parts = [_of_sweep(sweeps.take(sweeps.number == number), model) for number in np.unique(sweeps.number)]
    found = [part for part in parts if part is not None]
    return UnreturnedRays.join(found), "" if found or not parts else NO_RINGS


def near_excluded(rays: UnreturnedRays, excluded: Sweeps) -> Bools:
    """(M,) whether rays are within `NEAR_RAD` of an excluded return of their sweep: they may have met its object."""
    from scipy.spatial import cKDTree

    near = np.zeros(len(rays), bool)
    for number in np.unique(excluded.number):
        own, there = np.flatnonzero(rays.number == number), excluded.take(excluded.number == number)
        way = there.xyz - there.origins
        tree = cKDTree(way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9))
        near[own] = np.isfinite(tree.query(rays.directions[own], distance_upper_bound=NEAR_RAD, workers=-1)[0])
    return near


def pass_through(rays: UnreturnedRays, distance: F32, inside: Callable[[F32], Bools]) -> Bools:
    """(M,) whether rays pass through excluded objects before they end at `distance` (M,) metres.

    Args:
        rays: the rays.
        distance: finite.
        inside: (N,) whether points (N, 3), local metres, are in an excluded object.
    """
    count = np.ceil(distance / BOX_STEP_M).astype(np.int64)
    ray = np.repeat(np.arange(len(rays)), count)
    way = (np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)) * BOX_STEP_M
    found = inside((rays.origins[ray] + way[:, None] * rays.directions[ray]).astype(np.float32))
    return np.bincount(ray[found], minlength=len(rays)) > 0


def _of_sweep(sweep: Sweeps, model: RingModel) -> UnreturnedRays | None:
    """Rays without a return of one sweep; None if its returns aren't in order of rings."""
    if len(sweep) < model.min_rings * model.min_returns_per_ring:
        return None
    azimuth = _azimuth(sweep.scanned)
    step = np.mod(np.diff(azimuth) + np.pi, 2 * np.pi) - np.pi
    turn = 1 if np.median(np.sign(step)) >= 0 else -1
    along = np.mod(turn * azimuth - _start(turn * azimuth, _elevation(sweep.scanned), model), 2 * np.pi)
    # noise of motion compensation may cross the start of a ring back and forth
    begins, undone = np.diff(along) < -np.pi / 2, np.diff(along) > 1.5 * np.pi
    ring = np.append(0, np.cumsum(begins.astype(np.int64) - undone))
    within = np.diff(along)[np.diff(ring) == 0]
    resolution = float(np.median(within[within > 0])) if (within > 0).any() else np.inf
    rings = np.unique(ring)
    if (
        not model.min_rings <= len(rings) <= model.max_rings
        or len(sweep) < model.min_returns_per_ring * len(rings)
        or (within < 0).mean() > model.max_backwards
        or resolution > model.max_step_rad
    ):
        return None
    way = sweep.xyz - sweep.origins
    shift = turn * _azimuth(way) - along  # from the scanner's axes to local ones: a rotation and motion compensation
    along += np.mod(shift - shift[0] + np.pi, 2 * np.pi) - np.pi + shift[0]
    parts = [_of_ring(sweep, way, np.flatnonzero(ring == r), along, turn, resolution) for r in rings]
    return UnreturnedRays.join(parts)


def _start(azimuth: F64, elevation: F64, model: RingModel) -> float:
    """Azimuth at which rings start, in the direction of rotation: where all elevations ascend, or descend."""
    size = 2 * np.pi / model.start_bins
    own = np.floor(np.mod(azimuth, 2 * np.pi) / size).astype(np.int64)
    half = model.start_returns
    at = np.flatnonzero(np.diff(own) % model.start_bins == 1)
    at = at[(at >= half - 1) & (at + half < len(azimuth))]
    if not len(at):
        return 0.0
    window = np.arange(half)
    jump = np.median(elevation[at[:, None] + 1 + window], 1) - np.median(elevation[at[:, None] - window], 1)
    bins = own[at + 1]
    # between rings, (almost) all jumps have the same sign; at edges of close objects some do
    common = {k: np.percentile(jump[bins == k], [20, 80]) for k in np.unique(bins)}
    return float(max(common, key=lambda k: max(common[k][0], -common[k][1])) * size)


def _of_ring(sweep: Sweeps, way: F64, index: I64, azimuth: F64, turn: int, resolution: float) -> UnreturnedRays:
    """Rays in the gaps of a ring: azimuth in equal steps, elevation between those of its returns."""
    way, azimuth = way[index], np.maximum.accumulate(azimuth[index])
    azimuth = np.append(azimuth, azimuth[0] + 2 * np.pi)  # the gap between its end and its start
    elevation = _elevation(way)
    after = np.append(np.arange(1, len(index)), 0)
    missing = np.maximum(np.round(np.diff(azimuth) / resolution).astype(np.int64) - 1, 0)
    before = np.repeat(np.arange(len(index)), missing)
    part = (np.arange(len(before)) - np.repeat(np.cumsum(missing) - missing, missing) + 1) / (missing[before] + 1)
    at = turn * (azimuth[before] * (1 - part) + azimuth[before + 1] * part)
    wave = _wave(turn * azimuth[:-1], elevation)
    rest = elevation - _waves(turn * azimuth[:-1]) @ wave
    up = _waves(at) @ wave + rest[before] * (1 - part) + rest[after[before]] * part
    directions = np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=1)
    recorded = np.linalg.norm(way, axis=1)
    begin, end = sweep.origins[index[before]], sweep.origins[index[after[before]]]
    return UnreturnedRays(
        sweep.number[index[before]],
        begin * (1 - part)[:, None] + end * part[:, None],
        directions,
        np.stack([recorded[before], recorded[after[before]]], axis=1).astype(np.float32),
    )


def _azimuth(way: npt.NDArray[np.floating]) -> F64:
    return np.asarray(np.arctan2(way[:, 1], way[:, 0]), np.float64)


def _elevation(way: npt.NDArray[np.floating]) -> F64:
    return np.asarray(np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1])), np.float64)


def _waves(azimuth: F64) -> F64:
    return np.stack([np.ones(len(azimuth)), np.cos(azimuth), np.sin(azimuth)], axis=1)


def _wave(azimuth: F64, elevation: F64) -> F64:
    """Elevation of a ring over azimuth, coefficients (3,) of `_waves`: level, or a wave in tilted axes."""
    sectors = np.unique(np.floor(np.mod(azimuth, 2 * np.pi) / (np.pi / 18)))
    if len(sectors) < 18:  # less than half of the turn doesn't determine the wave
        return np.array([np.median(elevation), 0, 0])
    return np.asarray(np.linalg.lstsq(_waves(azimuth), elevation, rcond=None)[0])
