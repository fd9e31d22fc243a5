"""Sections of an assembled cloud: points that a moving scanner measured within a few metres of its path.

A cloud whose points have times, and the path by which it was assembled, are cut into sections, as if each were a sweep,
so that sections that show the same surfaces can be compared (`slam.scan_pairs`). Points are relative to the scanner's
position at their own time, in the world's axes: a path without rotations suffices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.importers.scanner_path import MAX_POSE_GAP_S, ScannerPath
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.gps_time import clock_offsets
from scan2sim.slam import scan_pairs
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.trajectory.strip_adjustment import correction


@dataclass(frozen=True)
class SectionModel:
    """Size of the sections, and limits."""

    length_m: float = 2.0
    """Length of a section of the path."""
    duration_s: float = 10.0
    """Longest duration of a section: a standing vehicle."""
    sections_max: int = 4000
    """Number of sections above which they become longer."""
    points_max: int = 12_000
    """Points of a section that are kept."""
    all_points_max: int = 24_000_000
    """Points of all sections that are kept."""
    points_min: int = 500
    """Points below which a section is left out."""
    voxel_m: float = 0.1
    """Points of a section are thinned to one per voxel."""
    sample: int = 20_000
    """Points of each cloud by which the clocks of cloud and path are compared."""
    matching_share_min: float = 0.5
    """Least share of these points that the path passes within range at their time."""
    beside_m: float = 8.0
    """Horizontal distance of the points by which the height of the scanner is measured."""
    beside_min: int = 100
    """Number of these points below which it isn't."""
    lowest_percentile: float = 5.0
    """Percentile of their heights that is the ground's."""


MODEL = SectionModel()
CELLS = 1 << 12
"""Voxels along an axis of a section."""


class UncheckableError(Exception):
    """A cloud can't be compared with the path; the message says why."""


@dataclass(frozen=True)
class Sections:
    """Sections of a cloud.

    Attributes:
        times: (N,) seconds, clock of the cloud: mean times of the sections' points.
        positions: (N, 3) metres of the scanner at these times.
        after_gap: (N,) whether the path has a gap between a section and the previous one.
        points: of each section, (M, 3) metres relative to the scanner's position at the points' own times.
        ages: of each section, (M,) seconds after its time.
        path: path of the scanner, clock of the cloud.
    """

    times: F64
    positions: F64
    after_gap: Bools
    points: list[F32]
    ages: list[F32]
    path: Trajectory

    @property
    def poses(self) -> F64:
        """Poses (N, 4, 4) at the sections' times, with the world's axes."""
        poses = np.tile(np.eye(4), (len(self.times), 1, 1))
        poses[:, :3, 3] = self.positions
        return poses

    def at(self, i: int, path: ScannerPath) -> F64:
        """Points (M, 3) of a section in the axes of its pose, by a corrected path with a pose for each section."""
        shift, turn = correction(self.poses, path.T)
        times = self.times[i] + self.ages[i].astype(np.float64)

        def interpolated(values: F64) -> F64:
            return np.stack([np.interp(times, self.times, values[:, k]) for k in range(3)], axis=1)

        local = np.einsum("nij,nj->ni", exp_so3(interpolated(turn)), self.points[i])
        world = local + self.path.at(times) + interpolated(shift)
        return (world - path.T[i, :3, 3]) @ path.T[i, :3, :3]


class Match(NamedTuple):
    """How a path fits to clouds.

    Attributes:
        offset: seconds to add to the path's times, to convert them to the clock of the clouds.
        height: metres of the scanner above the lowest points beside it, in the middle; NaN if there are too few.
    """

    offset: float
    height: float


def match(clouds: Sequence[Path], path: Trajectory, frame: Frame) -> Match:
    """Clock of a path, and its height above the ground, by points of the clouds.

    Args:
        clouds: files in one CRS.
        path: path of the scanner, metres in the CRS's axes.
        frame: CRS and unit of the clouds.

    Raises:
        UncheckableError: points have no times, none of the usual clocks matches, or points are too far away.
        ScanError: a cloud can't be read.
    """
    samples = [_sample(cloud, frame) for cloud in clouds]
    xyz, times = (np.concatenate(parts) for parts in zip(*samples, strict=True))

    def from_path(offset: float) -> F64:
        """(N, 3) from the scanner to the points that it measured; infinite outside of the path."""
        at = times - offset
        within = (at >= path.times[0] - 1) & (at <= path.times[-1] + 1)
        return np.where(within[:, None], xyz - path.at(at), np.inf)

    def near(offset: float, axes: int = 2) -> float:
        distance = np.linalg.norm(from_path(offset)[:, :axes], axis=1)
        return float((distance < scan_pairs.MODEL.range_m).mean())

    spans = (float(np.median(times)), float(path.times[0] + path.times[-1]) / 2)
    offset = 0.0
    if near(0.0) < MODEL.matching_share_min:
        share, offset = max(((near(offset), offset) for offset in clock_offsets(*spans)), default=(0.0, 0.0))
        if share < MODEL.matching_share_min:
            raise _no_clock(times, path)
    found = Match(offset, _height(from_path(offset)))
    if near(offset, axes=3) < MODEL.matching_share_min:
        raise UncheckableError(
            f"most points are farther than {scan_pairs.MODEL.range_m:.0f} m from the trajectory at their time, which "
            f"is {found.height:.0f} m above the lowest ones beside it: an airborne cloud, or heights of another datum"
        )
    return found


def _height(from_path: F64) -> float:
    """Height (m) of the scanner above the lowest of the points (N, 3) beside it; NaN if there are too few."""
    beside = from_path[np.hypot(from_path[:, 0], from_path[:, 1]) < MODEL.beside_m, 2]
    if len(beside) < MODEL.beside_min:
        return float("nan")
    return -float(np.percentile(beside, MODEL.lowest_percentile))


def _no_clock(times: F64, path: Trajectory) -> UncheckableError:
    if ((times >= path.times[0] - 1) & (times <= path.times[-1] + 1)).mean() >= MODEL.matching_share_min:
        return UncheckableError(
            f"most points are farther than {scan_pairs.MODEL.range_m:.0f} m from the trajectory at their time: an "
            "airborne cloud, or clocks that differ"
        )
    return UncheckableError(
        f"the points' times are {times.min():.1f} to {times.max():.1f} s, those of the trajectory "
        f"{path.times[0]:.1f} to {path.times[-1]:.1f} s, which isn't the same time in another GPS or UNIX clock"
    )


def _sample(cloud: Path, frame: Frame) -> tuple[F64, F64]:
    """Some points (N, 3) of a cloud's first chunk, metres in the CRS's axes, and their times (N,)."""
    part = next(iter(cloud_io.chunks(cloud, frame)))
    if part.time is None or not part.time.any():
        raise UncheckableError(f"the points of {cloud.name} have no GPS times")
    some = part.take(slice(0, None, max(1, len(part) // MODEL.sample)))
    assert some.time is not None
    return some.xyz + np.asarray(some.frame.origin), some.time


class _Progress:
    """Progress of a path in sections: section of any time; -1 in gaps and outside of it."""

    def __init__(self, path: Trajectory) -> None:
        seconds = np.diff(path.times)
        metres = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
        length = max(MODEL.length_m, float(metres.sum()) / MODEL.sections_max)
        self.gap = seconds > max(MAX_POSE_GAP_S, 3 * float(np.median(seconds)))
        steps = np.maximum(metres / length, seconds / MODEL.duration_s)
        self.times, self.at = path.times, np.zeros(len(path))
        start = 0.0
        for part in np.split(np.arange(len(path)), np.flatnonzero(self.gap) + 1):
            self.at[part] = start + np.concatenate([[0], np.cumsum(steps[part[:-1]])])
            start = float(np.floor(self.at[part[-1]])) + 1
        self.count = int(start)

    def sections(self, times: F64) -> I64:
        """Sections (N,) of times (N,)."""
        found = np.floor(np.interp(times, self.times, self.at)).astype(np.int64)
        before = np.clip(np.searchsorted(self.times, times, "right") - 1, 0, len(self.gap) - 1)
        out = (times < self.times[0]) | (times > self.times[-1]) | (self.gap[before] & (times > self.times[before]))
        found[out] = -1
        return found


@dataclass
class _Buffer:
    """Points kept of a section: relative positions (M, 3) and times (M,), in parts."""

    limit: int
    xyz: list[F32] = field(default_factory=list)
    times: list[F64] = field(default_factory=list)
    count: int = 0

    def add(self, xyz: F32, times: F64, rng: np.random.Generator) -> None:
        self.xyz.append(xyz)
        self.times.append(times)
        self.count += len(xyz)
        if self.count > 2 * self.limit:
            self.reduce(rng)

    def reduce(self, rng: np.random.Generator) -> None:
        """Keep at most `limit` points."""
        xyz, times = np.concatenate(self.xyz), np.concatenate(self.times)
        kept = np.sort(rng.permutation(len(xyz))[: self.limit])
        self.xyz, self.times, self.count = [xyz[kept]], [times[kept]], len(kept)


def read(clouds: Sequence[Path], path: Trajectory, frame: Frame, report: Report) -> Sections:
    """Cut clouds into sections.

    Args:
        clouds: files in one CRS, in any order of time.
        path: path of the scanner, metres in the CRS's axes, clock of the clouds.
        frame: CRS and unit of the clouds.
        report: receives progress.

    Raises:
        UncheckableError: a part of the points has no times, or there are too few sections.
        ScanError: a cloud can't be read.
    """
    progress, rng = _Progress(path), np.random.default_rng(0)
    limit = max(MODEL.points_min, min(MODEL.points_max, MODEL.all_points_max // progress.count))
    buffers: dict[int, _Buffer] = {}
    total, done = max(1, sum(cloud_io.read_header(cloud).count for cloud in clouds)), 0
    for cloud in clouds:
        for part in cloud_io.chunks(cloud, frame):
            done += len(part)
            report(min(1.0, done / total), cloud.name)
            if part.time is None or not part.time.any():
                raise UncheckableError(f"a part of the points of {cloud.name} has no GPS times")
            _add(buffers, part, part.time, progress, path, limit, rng)
    for section in [key for key, buffer in buffers.items() if buffer.count < MODEL.points_min]:
        del buffers[section]
    order = sorted(buffers)
    if len(order) < 2:
        raise UncheckableError("too few points are near the trajectory at their time")
    points, ages, times = list[F32](), list[F32](), list[float]()
    for key in order:
        buffer = buffers.pop(key)
        buffer.reduce(rng)
        times.append(float(buffer.times[0].mean()))
        points.append(buffer.xyz[0])
        ages.append((buffer.times[0] - times[-1]).astype(np.float32))
    middle = np.array(times)
    gaps = np.concatenate([[0], np.cumsum(progress.gap)])
    at_gap = gaps[np.clip(np.searchsorted(path.times, middle, "right") - 1, 0, len(gaps) - 1)]
    return Sections(middle, path.at(middle), np.diff(at_gap, prepend=at_gap[:1]) > 0, points, ages, path)


def _add(
    buffers: dict[int, _Buffer],
    part: PointCloud,
    times: F64,
    progress: _Progress,
    path: Trajectory,
    limit: int,
    rng: np.random.Generator,
) -> None:
    """Add a chunk's points to their sections."""
    section = progress.sections(times)
    local = part.xyz + (np.asarray(part.frame.origin) - path.at(times))
    inside = np.flatnonzero((section >= 0) & (np.linalg.norm(local, axis=1) < scan_pairs.MODEL.range_m))
    cells = np.floor(part.xyz[inside] / MODEL.voxel_m).astype(np.int64) % CELLS
    _, first = np.unique((section[inside] * CELLS**3) + cells @ [CELLS**2, CELLS, 1], return_index=True)
    kept = inside[first]
    kept = kept[np.argsort(section[kept], kind="stable")]
    starts = np.flatnonzero(np.diff(section[kept], prepend=-1))
    for index in np.split(kept, starts[1:]) if len(kept) else ():
        buffer = buffers.setdefault(int(section[index[0]]), _Buffer(limit))
        buffer.add(local[index].astype(np.float32), times[index], rng)
