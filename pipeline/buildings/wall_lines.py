"""Walls in plan view: straight runs of columns with points, found by voting for lines (Hough) and robust fits.

A wall's points are spread by the noise of the range and, where both sides were seen, by its thickness; a column is
therefore judged by how much of its height has points, not by its normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools


@dataclass(frozen=True)
class WallModel:
    """Limits of the search; lengths in metres."""

    cell: float = 0.05
    """Smallest side of a column."""
    layer: float = 0.1
    """Smallest height of a layer in which a column has points or not."""
    min_layers: int = 2
    normal_radius: float = 0.35
    """Neighbourhood in which a column's direction is measured."""
    line_ratio_max: float = 0.35
    """Ratio of the second to the first eigenvalue up to which a neighbourhood is a line."""
    theta_deg: float = 1.0
    rho: float = 0.05
    band: float = 0.25
    """Largest distance of a wall's column from its line: half a thick wall and noise."""
    normal_deg: float = 20.0
    gap: float = 1.6
    """Coplanar parts that are farther apart are walls of their own,"""
    filled_gap: float = 0.8
    """unless this share of the gap has columns: furniture at a wall has other directions."""
    filled_layers: int = 4
    min_length: float = 0.5
    max_runs: int = 400
    square_deg: float = 3.0
    """Runs this close to the main direction of all, or at a right angle to it, get it,"""
    askew_deg: float = 12.0
    """and those this close if columns within `support` of the line support it as well (`support_share`)."""
    support: float = 0.1
    support_share: float = 0.95


MODEL = WallModel()


@dataclass(frozen=True)
class Run:
    """A straight wall in plan view: points with |n . xy - offset| <= half and start <= t . xy <= end, t = (-ny, nx).

    Attributes:
        normal: (2,) unit vector.
        offset: metres.
        start, end: metres along the wall.
        half: half of the thickness of its points, noise included, metres.
    """

    normal: F64
    offset: float
    start: float
    end: float
    half: float

    @property
    def along(self) -> F64:
        """(2,) direction of the wall."""
        return np.array([-self.normal[1], self.normal[0]])

    @property
    def length(self) -> float:
        """Metres."""
        return self.end - self.start

    def coordinates(self, xyz: F32 | F64) -> tuple[F64, F64]:
        """Signed distance (N,) from the line and position (N,) along it, of points (N, 2 or 3)."""
        xy = np.asarray(xyz[:, :2], np.float64)
        return xy @ self.normal - self.offset, xy @ self.along

    def contains(self, xyz: F32 | F64, margin: float = 0.0) -> Bools:
        """(N,) whether points are in the wall."""
        xy = np.asarray(xyz[:, :2], np.float64)
        inside = np.abs(xy @ self.normal - self.offset) <= self.half + margin
        u = xy[inside] @ self.along
        inside[inside] = (u >= self.start - margin) & (u <= self.end + margin)
        return inside


@dataclass
class Columns:
    """Square columns in plan view that contain points.

    Attributes:
        xy: (C, 2) mean position of their points.
        layers: (C,) number of layers with points.
        cell, layer: sizes, metres.
    """

    xy: F64
    layers: I64
    cell: float
    layer: float


def columns(xyz: F32, spacing: float) -> Columns:
    """Columns of points (N, 3), N > 0, with typical distance `spacing` to their neighbours."""
    cell, layer = max(MODEL.cell, spacing), max(MODEL.layer, 1.5 * spacing)
    points = xyz.astype(np.float64)
    index = np.floor((points - points.min(axis=0)) / [cell, cell, layer]).astype(np.int64)
    wide, deep = index[:, 1].max() + 1, index[:, 2].max() + 1
    column = index[:, 0] * wide + index[:, 1]
    _, of_point, count = np.unique(column, return_inverse=True, return_counts=True)
    filled = np.unique(of_point * deep + index[:, 2]) // deep
    mean = np.stack([np.bincount(of_point, points[:, k]) / count for k in range(2)], axis=1)
    return Columns(mean, np.bincount(filled, minlength=len(count)), cell, layer)


def find_runs(found: Columns) -> list[Run]:
    """Runs of walls, the longest and highest first."""
    from scipy.spatial import cKDTree

    strong = np.flatnonzero(found.layers >= MODEL.min_layers)
    if len(strong) < 6:
        return []
    xy, weight = found.xy[strong], found.layers[strong].astype(np.float64)
    radius = max(MODEL.normal_radius, 4 * found.cell)
    normal, flat = _normals(xy, weight, cKDTree(xy), radius)
    middle = xy.mean(axis=0)
    runs: list[Run] = []
    free = flat.copy()
    band = max(MODEL.band, 2.5 * found.cell)
    votes = _Votes(xy - middle, normal, weight, max(MODEL.rho, found.cell))
    votes.add(np.flatnonzero(free), 1.0)
    while len(runs) < MODEL.max_runs:
        n, rho, best = votes.peak()
        if best < 2 * MODEL.min_length / found.cell * MODEL.min_layers:
            break
        offset = rho + float(n @ middle)
        own = _inliers(xy, normal, free, n, offset, band)
        for half in (band, band, 0.7 * band):
            if len(own) < 3:
                break
            n, offset = _fit(xy[own], weight[own], n)
            own = _inliers(xy, normal, free, n, offset, half)
        if len(own) < 3:
            near = _inliers(xy, normal, free, n, offset, 2 * band)
            drop = near if len(near) else votes.members_of_peak()
            votes.add(drop, -1.0)
            free[drop] = False
            continue
        own = _inliers(xy, normal, free, n, offset, band)
        u = xy[own] @ np.array([-n[1], n[0]])
        thick = (np.abs(xy @ n - offset) <= 0.6 * band) & (weight >= MODEL.filled_layers)
        beside = xy[thick] @ np.array([-n[1], n[0]])
        of = np.searchsorted(_ends_of_parts(np.sort(u), beside, found.cell), u)
        parts = [own[of == k] for k in np.unique(of)]
        for part in parts:
            if len(part) < 3 or np.ptp(xy[part] @ np.array([-n[1], n[0]])) + found.cell < MODEL.min_length:
                continue
            m, at = _fit(xy[part], weight[part], n)
            d, along = xy[part] @ m - at, xy[part] @ np.array([-m[1], m[0]])
            half = float(np.clip(1.05 * _quantile(np.abs(d), weight[part], 0.95), 0.04, band)) + found.cell / 2
            runs.append(Run(m, at, float(along.min() - found.cell / 2), float(along.max() + found.cell / 2), half))
        votes.add(own, -1.0)
        free[own] = False
    return sorted(_squared(runs, xy, weight), key=lambda run: -run.length)


def _ends_of_parts(u: F64, beside: F64, cell: float) -> F64:
    """Positions between the parts of a line: gaps of its columns `u` (sorted) that no others (`beside`) fill."""
    filled = np.unique(np.floor(beside / (2 * cell)))
    ends = []
    for k in np.flatnonzero(np.diff(u) > MODEL.gap):
        first, last = np.searchsorted(filled, u[k : k + 2] / (2 * cell))
        if last - first < MODEL.filled_gap * (u[k + 1] - u[k]) / (2 * cell):
            ends.append((u[k] + u[k + 1]) / 2)
    return np.array(ends)


def _squared(runs: list[Run], xy: F64, weight: F64) -> list[Run]:
    """The runs, turned to the building's main direction if they are close to it, or if as many columns support that.

    Args:
        runs: walls.
        xy: (C, 2) columns.
        weight: (C,) number of their layers.
    """
    if not runs:
        return runs
    angle = np.array([np.arctan2(run.normal[1], run.normal[0]) for run in runs])
    size = np.array([run.length**2 for run in runs])
    main = float(np.angle((size * np.exp(4j * angle)).sum())) / 4
    for _ in range(5):
        off = (angle - main + np.pi / 4) % (np.pi / 2) - np.pi / 4
        near = np.abs(off) < np.radians(MODEL.square_deg)
        if not near.any():
            return runs
        main += float((size * off)[near].sum() / size[near].sum())
    off = (angle - main + np.pi / 4) % (np.pi / 2) - np.pi / 4
    result = []
    for run, a, o in zip(runs, angle, off, strict=True):
        if abs(o) < np.radians(MODEL.square_deg):
            result.append(_turned(run, a - o))
        elif abs(o) < np.radians(MODEL.askew_deg):
            result.append(_straightened(run, _turned(run, a - o), xy, weight))
        else:
            result.append(run)
    return result


def _straightened(run: Run, turned: Run, xy: F64, weight: F64) -> Run:
    """The turned run, moved to most columns, if as many support it as the run itself; else the run."""
    d, u = turned.coordinates(xy)
    near = (np.abs(d) < 2 * MODEL.band) & (u >= turned.start) & (u <= turned.end)
    own = np.abs(run.coordinates(xy)[0]) < MODEL.support
    shifts = np.arange(-MODEL.band, MODEL.band + 0.01, 0.02)
    support = [float(weight[near & (np.abs(d - shift) < MODEL.support)].sum()) for shift in shifts]
    best = int(np.argmax(support))
    if support[best] < MODEL.support_share * float(weight[near & own].sum()):
        return run
    inside = near & (np.abs(d - shifts[best]) < MODEL.support)
    middle = _quantile(d[inside], weight[inside], 0.5)
    return Run(turned.normal, turned.offset + middle, turned.start, turned.end, turned.half)


def _turned(run: Run, angle: float) -> Run:
    """The run with another direction, about its middle."""
    middle = run.offset * run.normal + (run.start + run.end) / 2 * run.along
    normal = np.array([np.cos(angle), np.sin(angle)])
    centre = float(middle @ [-normal[1], normal[0]])
    return Run(normal, float(middle @ normal), centre - run.length / 2, centre + run.length / 2, run.half)


def refined(run: Run, xy: F64) -> Run:
    """The run with offset and thickness of its own points (N, 2): extents of most parts, so that cupboards don't count.

    Furniture at a wall extends some of its parts on one side only.
    """
    near = xy[run.contains(xy, 0.05)]
    d, u = run.coordinates(near)
    bins = max(1, round(run.length / 0.5))
    k = np.clip(((u - run.start) / run.length * bins).astype(np.int64), 0, bins - 1)
    ends = [np.quantile(d[k == i], (0.02, 0.98)) for i in range(bins) if (k == i).sum() >= 12]
    if not ends:
        return run
    lows, highs = np.array(ends).T
    low, high = float(np.quantile(lows, 0.65)), float(np.quantile(highs, 0.35))
    if high - low < 0.03:
        return run
    return Run(run.normal, run.offset + (low + high) / 2, run.start, run.end, (high - low) / 2)


def wall_noise(runs: Sequence[Run]) -> float:
    """Half of the spread of a wall of which one side was seen, metres: the thinnest of all long ones."""
    if not runs:
        return 0.0
    long = sorted(runs, key=lambda run: -run.length)[: max(4, len(runs) // 2)]
    return float(np.quantile([run.half for run in long], 0.2))


class _Votes:
    """Accumulator of lines by angle and distance from the origin; every column votes for those near its normal."""

    def __init__(self, xy: F64, normal: F64, weight: F64, rho: float) -> None:
        self.xy, self.weight, self.cell = xy, weight, rho
        self.count = round(180 / MODEL.theta_deg)
        self.angle = np.radians(MODEL.theta_deg) * np.arange(self.count)
        self.own = np.degrees(np.arctan2(normal[:, 1], normal[:, 0])) % 180 / MODEL.theta_deg
        self.far = int(np.ceil(np.linalg.norm(xy, axis=1).max() / rho)) + 2
        self.votes = np.zeros((self.count, 2 * self.far + 1))
        self.spread = np.arange(-4, 5)

    def _cells(self, members: I64) -> tuple[I64, I64]:
        theta = (np.rint(self.own[members]).astype(np.int64)[:, None] + self.spread) % self.count
        direction = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=1)
        rho = np.einsum("nkj,nj->nk", direction[theta], self.xy[members])
        return theta, np.rint(rho / self.cell).astype(np.int64) + self.far

    def add(self, members: I64, sign: float) -> None:
        """Add (1) or remove (-1) the votes of some columns."""
        theta, rho = self._cells(members)
        np.add.at(self.votes, (theta, rho), sign * self.weight[members][:, None] * np.exp(-((self.spread / 3.0) ** 2)))

    def peak(self) -> tuple[F64, float, float]:
        """Normal (2,), distance and votes of the best line, over five distances (a wall's thickness)."""
        total = np.cumsum(np.pad(self.votes, ((0, 0), (3, 2))), axis=1)
        wide = total[:, 5:] - total[:, :-5]
        self._best = divmod(int(wide.argmax()), wide.shape[1])
        k, i = self._best
        return np.array([np.cos(self.angle[k]), np.sin(self.angle[k])]), (i - self.far) * self.cell, float(wide.max())

    def members_of_peak(self) -> I64:
        """Columns that voted for it."""
        theta, rho = self._cells(np.arange(len(self.xy)))
        k, i = self._best
        return np.flatnonzero(((theta == k) & (np.abs(rho - i) <= 2)).any(axis=1))


def _normals(xy: F64, weight: F64, tree: object, radius: float) -> tuple[F64, Bools]:
    """Normal (C, 2) of each column's neighbourhood, and whether that is a line."""
    pairs = tree.query_pairs(radius, output_type="ndarray")  # type: ignore[attr-defined]
    both = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(len(xy))[:, None], 2, axis=1)])
    a, b = both.T
    n, w = len(xy), weight[b]
    total = np.bincount(a, w, n)
    apart = xy[b] - xy[a]
    mean = np.stack([np.bincount(a, w * apart[:, k], n) / total for k in range(2)], axis=1)
    xx, yy, xyy = (np.bincount(a, w * v, n) / total for v in (apart[:, 0] ** 2, apart[:, 1] ** 2, apart.prod(axis=1)))
    xx, yy, xyy = xx - mean[:, 0] ** 2, yy - mean[:, 1] ** 2, xyy - mean.prod(axis=1)
    spread = np.hypot((xx - yy) / 2, xyy)
    large, small = (xx + yy) / 2 + spread, (xx + yy) / 2 - spread
    along = 0.5 * np.arctan2(2 * xyy, xx - yy)
    return np.stack([-np.sin(along), np.cos(along)], axis=1), small < MODEL.line_ratio_max * np.maximum(large, 1e-12)


def _inliers(xy: F64, normal: F64, free: Bools, n: F64, offset: float, half: float) -> I64:
    near = free & (np.abs(xy @ n - offset) <= half)
    return np.flatnonzero(near & (np.abs(normal @ n) > np.cos(np.radians(MODEL.normal_deg))))


def _fit(xy: F64, weight: F64, n: F64) -> tuple[F64, float]:
    """Line through columns, by total least squares with Tukey's weights around the current direction."""
    offset = _quantile(xy @ n, weight, 0.5)
    for _ in range(3):
        d = xy @ n - offset
        scale = max(2.5 * _quantile(np.abs(d), weight, 0.68), 0.02)
        w = weight * np.maximum(0.0, 1 - (d / scale) ** 2) ** 2
        if (w > 0).sum() < 3:
            break
        mean = (xy * w[:, None]).sum(axis=0) / w.sum()
        apart = xy - mean
        vectors = np.linalg.eigh((apart * w[:, None]).T @ apart)[1]
        turned = vectors[:, 0] if vectors[:, 0] @ n >= 0 else -vectors[:, 0]
        if turned @ n < 0.9:  # too short to determine its direction
            break
        n, offset = turned, float(turned @ mean)
    return n, offset


def _quantile(values: F64, weight: F64, q: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[min(int(np.searchsorted(total, q * total[-1])), len(values) - 1)]])
