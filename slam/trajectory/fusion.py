"""Fusion: one path of a scanner by its sweeps, a camera's trajectory and GPS, as factors of one graph.

The graph is a chain of states, one a sweep: the scanner's pose, the logarithm of the camera's scale there, and GPS's
slow error. Factors between neighbours are the lidar's step with its covariance, the camera's step (in its scale, which
drifts), and how scale and GPS's error go on; factors of one state are GPS's fixes. Those that contradict the others
count little (Cauchy). Gauss-Newton over a banded system takes time and memory by the length of the drive alone, and
its blocks give every pose's covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.camera.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.types import F64, I64, Bools, Trajectory
from scan2sim.slam.geometry import exp_so3, inverse, log_so3
from scan2sim.slam.lidar_odometry import Matched
from scan2sim.slam.trajectory.align import place

SIZE = 10
"""Of a state: position (m), rotation (rad, about the world's axes), logarithm of the camera's scale, GPS's error."""
POSE, SCALE, ERROR = slice(0, 6), slice(6, 7), slice(7, 10)
CAMERA = (0.005, 0.01, 0.0007)
"""Of a camera's step: metres, share of its length, radians."""
DRIFT = 0.02
"""Of a camera's scale, over a way of ten metres (`scale.AHEAD` allows more, in turns)."""
UNIT = 1.0
"""Of the logarithm of a camera's scale at first: without GPS, its unit is any."""
HELD = (1e-3, 1e-4)
"""Metres and radians of the first pose, where nothing else says where the world is."""
LEVEL = 0.02
"""Radians by which the whole path may be off the vertical, where GPS places it."""
ANYWHERE = 1e3
"""Metres, and radians about the vertical, of what GPS alone tells."""
HEIGHT = 2.0
"""How much worse GPS's heights are than its places."""
DOUBT = 4.0
"""Squared deviations, of each number of a factor, from which on it counts little."""
ROUNDS, STILL = 40, 1e-5
ANY_SPEED = (300.0, 10.0)
"""Metres and radians a second that no vehicle goes or turns."""
BELIEVED = 0.2
"""Weight of a factor from which on the others contradict it."""
LOST = (2.5, 0.02)
"""Metres, and share of the way, of deviation from which on a pose is unsure whatever held it to its neighbours."""


class Steps(NamedTuple):
    """What a sensor says of the way from each state to the next.

    Attributes:
        T: (L, 4, 4) pose of the second in the first's axes.
        covariance: (L, 6, 6) of position (m) and rotation (rad), in the second's axes.
        sure: (L,) whether the sensor saw that.
    """

    T: F64
    covariance: F64
    sure: Bools


class Fixes(NamedTuple):
    """Where GPS says that the scanner is.

    Attributes:
        places: (N, 3) in the world; NaN where it says nothing.
        scatter: metres, one standard deviation of a horizontal axis, from one to the next.
        slow: metres by which they are off together for `memory` seconds.
    """

    places: F64
    scatter: float
    slow: float
    memory: float


@dataclass(frozen=True)
class Fused:
    """What came out.

    Attributes:
        trajectory: of the scanner, in the world's axes, with covariance and where it is unsure.
        scale: (N,) what the camera's steps were multiplied by.
        trust: of each sensor, (L,) or (N,) how much its factors counted in the end, 0 to 1.
    """

    trajectory: Trajectory
    scale: F64
    trust: dict[str, F64]


def lidar_steps(matched: Matched) -> Steps:
    """What matched sweeps say of the way between them.

    Where nothing holds them (along a tunnel), they slide on and on: the errors of such a stretch's steps are one.
    """
    sure = matched.sure
    edges = np.flatnonzero(np.diff(np.concatenate([[True], sure, [True]]).astype(int)))
    length = np.ones(len(sure))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        length[first:end] = end - first
    T = inverse(matched.poses[:-1]) @ matched.poses[1:]
    return Steps(T, matched.covariance * length[:, None, None], sure)


def camera_steps(path: Trajectory, times: F64, gap: float = 1.0) -> Steps:
    """What a camera's path (rotations and all) says of the way between times (N,); nothing beyond it and in its gaps.

    Args:
        gap: seconds between two of its poses over which there is none in between.
    """
    poses = interpolate(path.poses, path.times, times)
    T = inverse(poses[:-1]) @ poses[1:]
    way = np.linalg.norm(T[:, :3, 3], axis=1)
    last = len(path) - 1
    before = np.clip(np.searchsorted(path.times, times[:-1] + 1e-6, "right") - 1, 0, last)
    after = np.clip(np.searchsorted(path.times, times[1:] - 1e-6), 0, last)
    unsure = np.concatenate([[0], np.cumsum(np.zeros(len(path)) if path.unsure is None else path.unsure)])
    wide = np.concatenate([[0], np.cumsum(np.diff(path.times) > gap)])
    seen = (times[:-1] > path.times[0] - 1e-6) & (times[1:] < path.times[-1] + 1e-6)
    seen &= (wide[after] == wide[before]) & (unsure[after + 1] == unsure[before])
    variance = np.repeat([[CAMERA[0] ** 2, CAMERA[2] ** 2]], len(T), axis=0)
    variance[:, 0] += (CAMERA[1] * way) ** 2
    if path.covariance is not None:
        variance += _growth(path.covariance, before, after, way)
    return Steps(T, np.repeat(variance, 3, axis=1)[:, :, None] * np.eye(6), seen)


def _growth(covariance: F64, before: I64, after: I64, way: F64) -> F64:
    """(L, 2) variances of position (m) and rotation (rad) that a path's own (T, 6, 6) covariance gains between poses.

    Of a place's, less what a turned path alone explains by the way between: where poses were bridged, that is much.
    """
    place, turn = (np.einsum("tkk->t", covariance[:, part, part]) / 3 for part in (slice(0, 3), slice(3, 6)))
    turn = np.where(np.isfinite(turn), turn, 0.0)
    lever = 2 * np.sqrt(place[before] * turn[before]) * way + turn[before] * way**2
    return np.maximum(np.stack([place[after] - place[before] - lever, turn[after] - turn[before]], axis=1), 0.0)


def fuse(
    times: F64,
    *,
    lidar: Steps | None = None,
    camera: Steps | None = None,
    T_camera_scanner: F64 | None = None,
    fixes: Fixes | None = None,
    first: F64 | None = None,
) -> Fused:
    """The scanner's path at times (N,) by what sensors say; at least one tells steps.

    Args:
        lidar: steps of the scanner itself.
        camera: steps of the camera, in a unit of its own.
        T_camera_scanner: (4, 4) scanner's axes to the camera's.
        fixes: by GPS.
        first: (4, 4) the scanner's first pose in a z-up world; by default its own axes are the world's.
    """
    mount = np.eye(4) if T_camera_scanner is None else inverse(T_camera_scanner)
    sensors = {"lidar": (lidar, np.eye(4)), "camera": (camera, mount)}
    told = {name: (steps, own) for name, (steps, own) in sensors.items() if steps is not None}
    graph = _Graph(times, told, fixes)
    starts = [graph.begin(name, np.eye(4) if first is None else first) for name in told]
    solved = min((graph.solve(start) for start in starts), key=graph.cost)
    return graph.finished(solved)


@dataclass(frozen=True)
class _States:
    """Where all states are: `poses` (N, 4, 4), `scale` (N,) its logarithm, `error` (N, 3) metres."""

    poses: F64
    scale: F64
    error: F64

    def moved(self, by: F64) -> _States:
        """By (N, SIZE)."""
        poses = self.poses.copy()
        poses[:, :3, 3] += by[:, :3]
        poses[:, :3, :3] = exp_so3(by[:, 3:6]) @ poses[:, :3, :3]
        return _States(poses, self.scale + by[:, 6], self.error + by[:, ERROR])


class _Block(NamedTuple):
    """Factors of a kind.

    Attributes:
        residual: (K, M) whitened.
        J: (K, M, SIZE) how it changes with the states `at` (K,).
        K: likewise, with the states after them, or None.
        weight: (K,) how much each counts.
        cost: (K,) what each costs.
    """

    residual: F64
    J: F64
    K: F64 | None
    at: I64
    weight: F64
    cost: F64


class _Graph:
    """The chain: what its factors say of states."""

    def __init__(self, times: F64, sensors: Mapping[str, tuple[Steps, F64]], fixes: Fixes | None) -> None:
        self.times, self.sensors, self.fixes = times, sensors, fixes
        self.seconds = np.diff(times)
        self._whiten = {
            name: np.linalg.inv(np.linalg.cholesky(steps.covariance)) for name, (steps, _) in sensors.items()
        }
        self._origin: F64 = np.eye(4)

    # --- states

    def begin(self, preferred: str, first: F64) -> _States:
        """States by the steps of one sensor, by the others' where it doesn't see; placed where GPS says."""
        n = len(self.times)
        unit = self._unit()
        order = sorted(self.sensors, key=lambda name: name != preferred)
        steps = np.tile(np.eye(4), (n - 1, 1, 1))
        known = np.zeros(n - 1, bool)
        for trusted in (True, False):
            for name in order:
                given, own = self.sensors[name]
                T = given.T.copy()
                if name == "camera":
                    T[:, :3, 3] *= unit
                take = ~known & (given.sure if trusted else np.full(n - 1, name == "lidar"))
                steps[take] = (own @ T @ inverse(own))[take]
                known |= take
        poses = [first]
        for i in range(n - 1):
            if not known[i] and i:
                steps[i] = steps[i - 1]
            poses.append(poses[-1] @ steps[i])
        chain = np.array(poses)
        if self.fixes is not None:
            turn, shift = place(chain[:, :3, 3], self.fixes.places)
            chain[:, :3, 3] = chain[:, :3, 3] @ turn.T + shift
            chain[:, :3, :3] = turn @ chain[:, :3, :3]
        self._origin = chain[0]
        return _States(chain, np.full(n, np.log(unit)), np.zeros((n, 3)))

    def _unit(self) -> float:
        """Metres of the camera's unit, roughly: by the lidar's steps, or by GPS."""
        if "camera" not in self.sensors:
            return 1.0
        camera = self.sensors["camera"][0]
        far = np.linalg.norm(camera.T[:, :3, 3], axis=1)
        if "lidar" in self.sensors:
            lidar = self.sensors["lidar"][0]
            both = camera.sure & lidar.sure & (far > 1e-3)
            ratio = np.linalg.norm(lidar.T[:, :3, 3], axis=1)[both] / far[both]
            return float(np.median(ratio)) if len(ratio) and np.median(ratio) > 1e-3 else 1.0
        if self.fixes is None:
            return 1.0
        way = np.concatenate([[0], np.cumsum(far)])
        known = np.flatnonzero(np.isfinite(self.fixes.places[:, 0]))
        ends = known[np.minimum(np.arange(len(known)) + max(1, len(known) // 4), len(known) - 1)]
        chords = np.linalg.norm(self.fixes.places[ends] - self.fixes.places[known], axis=1)
        driven = way[ends] - way[known]
        return float(np.median(chords[driven > 0] / driven[driven > 0])) if (driven > 0).any() else 1.0

    def solve(self, states: _States) -> _States:
        """States that fit all factors, by Gauss-Newton."""
        for _ in range(ROUNDS):
            D, above, g = self._normal(states)
            step = _solved(D, above, -g)
            states = states.moved(step)
            if np.abs(step[:, POSE]).max() < STILL:
                break
        return states

    def cost(self, states: _States) -> float:
        """What all factors cost."""
        return float(sum(block.cost.sum() for block in self._blocks(states).values()))

    def finished(self, states: _States) -> Fused:
        """The path of solved states, with covariance and where it is unsure."""
        blocks = self._blocks(states)
        D, above, _ = self._normal(states)
        covariance = _marginals(D, above)[:, POSE, POSE]
        seen = np.zeros(len(self.seconds), bool)
        for name, (steps, _) in self.sensors.items():
            seen |= steps.sure & (blocks[name].weight > BELIEVED)
        unsure = np.concatenate([~seen[:1], ~seen])
        way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(states.poses[:, :3, 3], axis=0), axis=1))])
        off = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
        unsure |= off > LOST[0] + LOST[1] * way
        poses = states.poses
        path = Trajectory(self.times, poses[:, :3, 3], nearest_rotation(poses[:, :3, :3]), unsure, covariance)
        sources = [name for name in blocks if name in self.sensors or name == "gps"]
        return Fused(path, np.exp(states.scale), {name: blocks[name].weight for name in sources})

    # --- factors

    def _normal(self, states: _States) -> tuple[F64, F64, F64]:
        """Of the normal equations: blocks on the diagonal (N, SIZE, SIZE) and above it; the gradient (N, SIZE)."""
        n = len(self.times)
        D, above, g = np.zeros((n, SIZE, SIZE)), np.zeros((n - 1, SIZE, SIZE)), np.zeros((n, SIZE))
        for r, J, K, at, weight, _ in self._blocks(states).values():
            Jw = J * weight[:, None, None]
            np.add.at(D, at, np.einsum("kma,kmb->kab", Jw, J))
            np.add.at(g, at, np.einsum("kma,km->ka", Jw, r))
            if K is not None:
                np.add.at(D, at + 1, np.einsum("kma,kmb->kab", K * weight[:, None, None], K))
                np.add.at(g, at + 1, np.einsum("kma,km->ka", K * weight[:, None, None], r))
                np.add.at(above, at, np.einsum("kma,kmb->kab", Jw, K))
        return D, above, g

    def _blocks(self, states: _States) -> dict[str, _Block]:
        """All factors, by their kind."""
        blocks = {name: self._steps(name, states) for name in self.sensors}
        blocks["carried"] = self._carried(states)
        blocks["first"] = self._first(states)
        blocks["unit"] = _quiet(states.scale[:1, None] / UNIT, _at(SCALE, 1 / UNIT)[None], None, np.zeros(1, np.int64))
        way = np.maximum(np.linalg.norm(np.diff(states.poses[:, :3, 3], axis=0), axis=1), 0.1)
        drift = DRIFT * np.sqrt(way / 10)
        blocks["scale"] = self._wander(states.scale[:, None], SCALE, np.ones(len(way)), drift[:, None])
        sigma = np.ones(3) if self.fixes is None else self.fixes.slow * np.array([1, 1, HEIGHT])
        keep = np.exp(-self.seconds / (60.0 if self.fixes is None else self.fixes.memory))
        blocks["error"] = self._wander(states.error, ERROR, keep, np.sqrt(1 - keep**2 + 1e-12)[:, None] * sigma)
        first = _at(ERROR, 1 / sigma)
        blocks["error.first"] = _quiet(states.error[:1] / sigma, first[None], None, np.zeros(1, np.int64))
        if self.fixes is not None:
            blocks["gps"] = self._fixes(states, self.fixes)
        return blocks

    def _steps(self, name: str, states: _States) -> _Block:
        """Of the steps of a sensor that is mounted at the scanner."""
        steps, own = self.sensors[name]
        R, t = states.poses[:, :3, :3], states.poses[:, :3, 3]
        lever = R @ own[:3, 3]
        S, c = R @ own[:3, :3], t + lever
        StT, ZT = S[:-1].transpose(0, 2, 1), steps.T[:, :3, :3].transpose(0, 2, 1)
        between = c[1:] - c[:-1]
        size = np.exp(states.scale[:-1]) if name == "camera" else np.ones(len(between))
        go = size[:, None] * steps.T[:, :3, 3]
        r = np.concatenate([
            np.einsum("kab,kb->ka", ZT, np.einsum("kab,kb->ka", StT, between) - go),
            log_so3(ZT @ StT @ S[1:]),
        ], axis=1)  # fmt: skip
        J, K = np.zeros((len(r), 6, SIZE)), np.zeros((len(r), 6, SIZE))
        A = ZT @ StT
        J[:, :3, :3], K[:, :3, :3] = -A, A
        J[:, :3, 3:6], K[:, :3, 3:6] = A @ (_cross(between) + _cross(lever[:-1])), -A @ _cross(lever[1:])
        J[:, 3:, 3:6], K[:, 3:, 3:6] = -S[1:].transpose(0, 2, 1), S[1:].transpose(0, 2, 1)
        if name == "camera":
            J[:, :3, SCALE] = -np.einsum("kab,kb->ka", ZT, go)[:, :, None]
        W = self._whiten[name]
        block = _loud(np.einsum("kab,kb->ka", W, r), W @ J, W @ K, np.arange(len(r)))
        if name == "camera":  # what it didn't see was made up
            block = block._replace(weight=block.weight * steps.sure, cost=block.cost * steps.sure)
        return block

    def _carried(self, states: _States) -> _Block:
        """Where no sensor tells anything, the way goes on evenly."""
        t, R = states.poses[:, :3, 3], states.poses[:, :3, :3]
        sigma = self.seconds[:, None] * np.repeat(ANY_SPEED, 3)
        r = np.concatenate([t[1:] - t[:-1], log_so3(R[1:] @ R[:-1].transpose(0, 2, 1))], axis=1) / sigma
        K = np.zeros((len(r), 6, SIZE))
        K[:, np.arange(6), np.arange(6)] = 1 / sigma
        return _quiet(r, -K, K, np.arange(len(r)))

    def _first(self, states: _States) -> _Block:
        """The first pose stays where it is; where GPS tells, it is upright."""
        T, origin = states.poses[0], self._origin
        sigma = np.repeat(HELD, 3)
        if self.fixes is not None:
            sigma = np.array([ANYWHERE, ANYWHERE, ANYWHERE, LEVEL, LEVEL, ANYWHERE])
        r = np.concatenate([T[:3, 3] - origin[:3, 3], log_so3(T[:3, :3] @ origin[:3, :3].T)]) / sigma
        J = np.zeros((1, 6, SIZE))
        J[0, np.arange(6), np.arange(6)] = 1 / sigma
        return _quiet(r[None], J, None, np.zeros(1, np.int64))

    def _wander(self, value: F64, part: slice, keep: F64, sigma: F64) -> _Block:
        """A part of the state is `keep` times what it was before, but for `sigma` (L, M)."""
        r = (value[1:] - keep[:, None] * value[:-1]) / sigma
        J, K = np.zeros((*r.shape, SIZE)), np.zeros((*r.shape, SIZE))
        J[:, :, part] = -keep[:, None, None] * (np.eye(r.shape[1]) / sigma[:, :, None])
        K[:, :, part] = np.eye(r.shape[1]) / sigma[:, :, None]
        return _quiet(r, J, K, np.arange(len(r)))

    def _fixes(self, states: _States, fixes: Fixes) -> _Block:
        at = np.flatnonzero(np.isfinite(fixes.places[:, 0]))
        sigma = fixes.scatter * np.array([1, 1, HEIGHT])
        r = (states.poses[at, :3, 3] + states.error[at] - fixes.places[at]) / sigma
        J = np.zeros((len(at), 3, SIZE))
        J[:, np.arange(3), np.arange(3)] = J[:, np.arange(3), np.arange(7, 10)] = 1 / sigma
        return _loud(r, J, None, at)


def _quiet(residual: F64, J: F64, K: F64 | None, at: I64) -> _Block:
    """Factors that count as they are."""
    return _Block(residual, J, K, at, np.ones(len(at)), (residual**2).sum(axis=1))


def _loud(residual: F64, J: F64, K: F64 | None, at: I64) -> _Block:
    """Factors that count little where they contradict the others (Cauchy)."""
    doubt = DOUBT * residual.shape[1]
    excess = (residual**2).sum(axis=1) / doubt
    return _Block(residual, J, K, at, 1 / (1 + excess), doubt * np.log1p(excess))


def _at(part: slice, value: F64 | float) -> F64:
    """(M, SIZE) a diagonal of `value` at a part of the state."""
    out = np.zeros((part.stop - part.start, SIZE))
    out[:, part] = np.eye(part.stop - part.start) * value
    return out


def _solved(D: F64, above: F64, b: F64) -> F64:
    """(N, SIZE) x of the block-tridiagonal system of `_Graph._normal`, by a banded Cholesky decomposition."""
    from scipy.linalg import solveh_banded

    n = len(D)
    band = np.zeros((2 * SIZE, n * SIZE))
    row, column = np.indices((SIZE, SIZE))
    upper = row <= column
    place = SIZE * np.arange(n)[:, None]
    band[(2 * SIZE - 1 + row - column)[upper], place + column[upper]] = D[:, row[upper], column[upper]]
    band[(SIZE - 1 + row - column).ravel(), place[1:] + column.ravel()] = above.reshape(n - 1, -1)
    return np.asarray(solveh_banded(band, b.ravel())).reshape(-1, SIZE)


def _marginals(D: F64, above: F64) -> F64:
    """(N, SIZE, SIZE) the blocks on the diagonal of the inverse."""
    left = np.empty_like(D)
    left[0] = D[0]
    for k in range(1, len(D)):
        left[k] = D[k] - above[k - 1].T @ np.linalg.solve(left[k - 1], above[k - 1])
    out = np.asarray(np.linalg.inv(left), np.float64)
    for k in range(len(D) - 2, -1, -1):
        G = out[k] @ above[k]
        out[k] += G @ out[k + 1] @ G.T
    return out


def _cross(v: F64) -> F64:
    """(N, 3, 3) matrices that multiply w (3,) to v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
