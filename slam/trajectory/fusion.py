"""Sensor fusion: a scanner's path from its sweeps, a camera's trajectory and GPS, by pose graph optimization.

The graph is a chain of states, one per sweep: the scanner's pose, the logarithm of the camera's scale, and GPS's slow
error (bias). Factors between neighbours are the lidar's relative motion with its covariance, the camera's relative
motion (in its drifting scale), an INS's relative motion, and the random walks of scale and bias; GPS fixes and an INS's
attitude are factors of one state. Links are factors between any two states, such as two passes of one place. The Cauchy
loss down-weights factors that contradict the others. Gauss-Newton over a banded system takes time and memory linear in
the length of the drive, and its blocks give the covariance of every pose (links only make it smaller).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.types import F64, I64, Bools, Trajectory
from scan2sim.pipeline.geometry.least_squares import (
    block_tridiagonal_marginals,
    cauchy_weights,
    moved,
    solve_block_tridiagonal,
)
from scan2sim.slam.geometry import inverse, lever_arm_jacobian, log_so3, relative_pose_error
from scan2sim.slam.lidar_odometry import MatchedSweeps
from scan2sim.slam.trajectory.align import align_to_gps

STATE_SIZE = 10
"""Size of a state: position (m), rotation (rad, about world axes), logarithm of the camera's scale, GPS bias (m)."""
POSE, SCALE, BIAS = slice(0, 6), slice(6, 7), slice(7, 10)
"""Parts of a state."""


@dataclass(frozen=True)
class FusionModel:
    """Noise model and limits of the fusion; standard deviations unless noted otherwise."""

    camera_sigma: tuple[float, float, float] = (0.005, 0.01, 0.0007)
    """Standard deviation of a camera's relative motion: metres, plus a share of its length; radians."""
    scale_drift: float = 0.02
    """Standard deviation of a camera's scale over ten metres (`scale.DRIFT_PERSPECTIVE` allows more, in turns)."""
    initial_scale_sigma: float = 1.0
    """Standard deviation of the logarithm of a camera's initial scale: without GPS its unit is arbitrary."""
    origin_sigma: tuple[float, float] = (1e-3, 1e-4)
    """Standard deviation of the first pose if it is the world's origin: metres, radians."""
    upright_sigma: float = 0.02
    """Standard deviation of the first pose's roll and pitch if GPS places the path, radians."""
    unknown_sigma: float = 1e3
    """Standard deviation of the first pose's position (m) and heading (rad) if GPS places the path."""
    speed_sigma: tuple[float, float] = (300.0, 10.0)
    """Metres and radians per second, faster than any vehicle: prior for motions that no sensor measured."""
    height_factor: float = 2.0
    """Ratio of GPS's vertical to its horizontal error."""
    cauchy_scale: float = 4.0
    """Squared scale of the Cauchy loss, per component of a factor."""
    iterations_max: int = 40
    step_min: float = 1e-5
    """Gauss-Newton stops at a smaller update (m, rad) of all poses."""
    trust_min: float = 0.2
    """Weight of a factor below which it contradicts the others."""
    attitude_sigma: tuple[float, float] = (0.01, 0.03)
    """Standard deviation of an INS's tilt and heading, radians; errors of its poses are correlated."""
    attitude_time: float = 60.0
    """Correlation time of the error of an INS's attitude, seconds."""
    unsure_sigma: tuple[float, float] = (2.5, 0.02)
    """Standard deviation of a position above which it is unsure: metres, plus a share of the distance driven."""


MODEL = FusionModel()


class RelativeMotions(NamedTuple):
    """Relative motions of a sensor from each state to the next.

    Attributes:
        T: (L, 4, 4) pose of the second state in the first's axes.
        covariance: (L, 6, 6) of position (m) and rotation (rad), in the second's axes.
        sure: (L,) whether the sensor measured the motion; otherwise it is extrapolated.
    """

    T: F64
    covariance: F64
    sure: Bools


class GpsFixes(NamedTuple):
    """GPS positions of the scanner.

    Attributes:
        positions: (N, 3) in the world; NaN where there is none.
        scatter: standard deviation of the independent error of each fix, horizontal axis, metres.
        bias: standard deviation of the slowly changing error, horizontal axis, metres.
        bias_time: correlation time of the slowly changing error, seconds.
    """

    positions: F64
    scatter: float
    bias: float
    bias_time: float


class Links(NamedTuple):
    """Measured relative poses of any two states, such as registered pairs of sweeps.

    Attributes:
        first, second: (K,) indices of the states.
        T: (K, 4, 4) pose of the second state in the first's axes.
        covariance: (K, 6, 6) of position (m) and rotation (rad), in the second's axes.
    """

    first: I64
    second: I64
    T: F64
    covariance: F64


@dataclass(frozen=True)
class Fused:
    """Result of the fusion.

    Attributes:
        trajectory: the scanner's trajectory in world axes, with covariance and unsure poses.
        scale: (N,) scale factor of the camera's motions.
        trust: by sensor, (L,) or (N,) final weights of its factors, 0 to 1.
    """

    trajectory: Trajectory
    scale: F64
    trust: dict[str, F64]


def lidar_motions(matched: MatchedSweeps) -> RelativeMotions:
    """Relative motions of matched sweeps.

    Over a degenerate stretch (a tunnel), the errors of all motions are correlated: each covariance is multiplied by
    the number of motions in the stretch.
    """
    sure = matched.sure
    edges = np.flatnonzero(np.diff(np.concatenate([[True], sure, [True]]).astype(int)))
    length = np.ones(len(sure))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        length[first:end] = end - first
    T = inverse(matched.poses[:-1]) @ matched.poses[1:]
    return RelativeMotions(T, matched.covariance * length[:, None, None], sure)


def camera_motions(path: Trajectory, times: F64, gap: float = 1.0) -> RelativeMotions:
    """Relative motions of a camera's trajectory between given times; unsure outside of it and in its gaps.

    Args:
        path: the trajectory, with rotations.
        times: (N,) seconds.
        gap: seconds between two of its poses above which there is a gap.
    """
    poses = interpolate(path.poses, path.times, times)
    T = inverse(poses[:-1]) @ poses[1:]
    length = np.linalg.norm(T[:, :3, 3], axis=1)
    last = len(path) - 1
    before = np.clip(np.searchsorted(path.times, times[:-1] + 1e-6, "right") - 1, 0, last)
    after = np.clip(np.searchsorted(path.times, times[1:] - 1e-6), 0, last)
    unsure = np.concatenate([[0], np.cumsum(np.zeros(len(path)) if path.unsure is None else path.unsure)])
    gaps = np.concatenate([[0], np.cumsum(np.diff(path.times) > gap)])
    sure = (times[:-1] > path.times[0] - 1e-6) & (times[1:] < path.times[-1] + 1e-6)
    sure &= (gaps[after] == gaps[before]) & (unsure[after + 1] == unsure[before])
    variance = np.repeat([[MODEL.camera_sigma[0] ** 2, MODEL.camera_sigma[2] ** 2]], len(T), axis=0)
    variance[:, 0] += (MODEL.camera_sigma[1] * length) ** 2
    if path.covariance is not None:
        variance += _covariance_growth(path.covariance, before, after, length)
    return RelativeMotions(T, np.repeat(variance, 3, axis=1)[:, :, None] * np.eye(6), sure)


def _covariance_growth(covariance: F64, before: I64, after: I64, length: F64) -> F64:
    """(L, 2) growth of a path's own covariance (T, 6, 6) between poses: variances of position (m) and rotation (rad).

    The part of the position's growth that the previous pose's rotation error explains (lever arm) is subtracted. Growth
    is large where poses were dead-reckoned.
    """
    position, turn = (np.einsum("tkk->t", covariance[:, part, part]) / 3 for part in (slice(0, 3), slice(3, 6)))
    turn = np.where(np.isfinite(turn), turn, 0.0)
    lever = 2 * np.sqrt(position[before] * turn[before]) * length + turn[before] * length**2
    growth = np.stack([position[after] - position[before] - lever, turn[after] - turn[before]], axis=1)
    return np.maximum(growth, 0.0)


def fuse(
    times: F64,
    *,
    lidar: RelativeMotions | None = None,
    camera: RelativeMotions | None = None,
    T_camera_scanner: F64 | None = None,
    ins: RelativeMotions | None = None,
    attitude: F64 | None = None,
    fixes: GpsFixes | None = None,
    links: Links | None = None,
    first: F64 | None = None,
) -> Fused:
    """The scanner's path from all given sensors; `lidar`, `camera` or `ins` is required.

    Args:
        times: (N,) seconds of the states.
        lidar: relative motions of the scanner.
        camera: relative motions of the camera, in an arbitrary unit.
        T_camera_scanner: (4, 4) scanner to camera.
        ins: relative motions of the scanner by an INS, metric.
        attitude: (N, 3, 3) rotation of the scanner to the world by an INS, whose tilt and heading are known roughly.
        fixes: GPS positions.
        links: relative poses of states, such as registered pairs of sweeps.
        first: (4, 4) the scanner's first pose in a z-up world; by default, the world's axes are those of this pose.
    """
    mount = np.eye(4) if T_camera_scanner is None else inverse(T_camera_scanner)
    sensors = {"lidar": (lidar, np.eye(4)), "camera": (camera, mount), "ins": (ins, np.eye(4))}
    given = {name: (motions, own) for name, (motions, own) in sensors.items() if motions is not None}
    graph = _Graph(times, given, fixes, attitude, links)
    starts = [graph.initial(name, np.eye(4) if first is None else first) for name in given]
    solved = min((graph.solve(start) for start in starts), key=graph.cost)
    return graph.finished(solved)


@dataclass(frozen=True)
class _States:
    """Values of all states: `poses` (N, 4, 4), logarithm of the `scale` (N,), GPS `bias` (N, 3) in metres."""

    poses: F64
    scale: F64
    bias: F64

    def moved(self, by: F64) -> _States:
        """States after an update (N, STATE_SIZE)."""
        return _States(moved(self.poses, by[:, POSE]), self.scale + by[:, 6], self.bias + by[:, BIAS])


class _Block(NamedTuple):
    """Factors of one kind.

    Attributes:
        residual: (K, M) whitened residuals.
        J: (K, M, STATE_SIZE) Jacobian by the states `at`.
        K: (K, M, STATE_SIZE) Jacobian by the states after them (of links: by their second states), or None.
        at: (K,) indices of the states, each at most once (except those of links).
        weight: (K,) robust weights.
        cost: (K,) costs.
    """

    residual: F64
    J: F64
    K: F64 | None
    at: I64
    weight: F64
    cost: F64


class _Graph:
    """Chain of states and their factors; `sensors`: relative motions, and pose of the sensor in scanner axes."""

    def __init__(
        self,
        times: F64,
        sensors: Mapping[str, tuple[RelativeMotions, F64]],
        fixes: GpsFixes | None,
        attitude: F64 | None,
        links: Links | None,
    ) -> None:
        self.times, self.sensors, self.fixes, self.attitude, self.links = times, sensors, fixes, attitude, links
        self.seconds = np.diff(times)
        self._whiten = {
            name: np.linalg.inv(np.linalg.cholesky(motions.covariance)) for name, (motions, _) in sensors.items()
        }
        self._origin: F64 = np.eye(4)

    # --- states

    def initial(self, preferred: str, first: F64) -> _States:
        """Initial states: motions of the preferred sensor, or of the others where it has none; aligned to GPS."""
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
                # in the second round, unsure motions of the lidar fill what is missing
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
            turn, shift = align_to_gps(chain[:, :3, 3], self.fixes.positions)
            chain[:, :3, 3] = chain[:, :3, 3] @ turn.T + shift
            chain[:, :3, :3] = turn @ chain[:, :3, :3]
        self._origin = chain[0]
        return _States(chain, np.full(n, np.log(unit)), np.zeros((n, 3)))

    def _unit(self) -> float:
        """Approximate metres per unit of the camera: by the lidar's motions, or by GPS."""
        if "camera" not in self.sensors:
            return 1.0
        camera = self.sensors["camera"][0]
        camera_length = np.linalg.norm(camera.T[:, :3, 3], axis=1)
        if "lidar" in self.sensors:
            lidar = self.sensors["lidar"][0]
            both = camera.sure & lidar.sure & (camera_length > 1e-3)
            ratio = np.linalg.norm(lidar.T[:, :3, 3], axis=1)[both] / camera_length[both]
            return float(np.median(ratio)) if len(ratio) and np.median(ratio) > 1e-3 else 1.0
        if self.fixes is None:
            return 1.0
        travelled = np.concatenate([[0], np.cumsum(camera_length)])
        known = np.flatnonzero(np.isfinite(self.fixes.positions[:, 0]))
        ends = known[np.minimum(np.arange(len(known)) + max(1, len(known) // 4), len(known) - 1)]
        gps_distance = np.linalg.norm(self.fixes.positions[ends] - self.fixes.positions[known], axis=1)
        driven = travelled[ends] - travelled[known]
        return float(np.median(gps_distance[driven > 0] / driven[driven > 0])) if (driven > 0).any() else 1.0

    def solve(self, states: _States) -> _States:
        """Optimized states, by Gauss-Newton."""
        for _ in range(MODEL.iterations_max):
            step = self._step(states)
            states = states.moved(step)
            if np.abs(step[:, POSE]).max() < MODEL.step_min:
                break
        return states

    def cost(self, states: _States) -> float:
        """Sum of the costs of all factors."""
        blocks = [*self._blocks(states).values(), *([] if self.links is None else [self._links(states, self.links)])]
        return float(sum(block.cost.sum() for block in blocks))

    def _step(self, states: _States) -> F64:
        """Gauss-Newton update (N, STATE_SIZE)."""
        D, above, g = self._normal(states)
        if self.links is None:
            return solve_block_tridiagonal(D, above, -g)
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import spsolve

        block = self._links(states, self.links)
        assert block.K is not None
        first, second = self.links.first, self.links.second
        Jw, Kw = ((part * block.weight[:, None, None]).transpose(0, 2, 1) for part in (block.J, block.K))
        np.add.at(g, first, np.einsum("kam,km->ka", Jw, block.residual))
        np.add.at(g, second, np.einsum("kam,km->ka", Kw, block.residual))
        n = np.arange(len(D))
        blocks = [D, above, above.transpose(0, 2, 1), Jw @ block.J, Kw @ block.K, Jw @ block.K, Kw @ block.J]
        rows = np.concatenate([n, n[:-1], n[1:], first, second, first, second])
        columns = np.concatenate([n, n[1:], n[:-1], first, second, second, first])
        row, column = np.indices((STATE_SIZE, STATE_SIZE))
        at = (
            (STATE_SIZE * rows[:, None, None] + row).ravel(),
            (STATE_SIZE * columns[:, None, None] + column).ravel(),
        )
        normal = coo_array((np.concatenate(blocks).ravel(), at), (g.size, g.size)).tocsc()
        return np.asarray(spsolve(normal, -g.ravel())).reshape(g.shape)

    def finished(self, states: _States) -> Fused:
        """Trajectory of optimized states, with covariance and unsure poses."""
        blocks = self._blocks(states)
        D, above, _ = self._normal(states)
        covariance = block_tridiagonal_marginals(D, above)[:, POSE, POSE]
        measured = np.zeros(len(self.seconds), bool)
        for name, (motions, _) in self.sensors.items():
            measured |= motions.sure & (blocks[name].weight > MODEL.trust_min)
        unsure = np.concatenate([~measured[:1], ~measured])
        travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(states.poses[:, :3, 3], axis=0), axis=1))])
        sigma = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
        unsure |= sigma > MODEL.unsure_sigma[0] + MODEL.unsure_sigma[1] * travelled
        poses = states.poses
        path = Trajectory(self.times, poses[:, :3, 3], nearest_rotation(poses[:, :3, :3]), unsure, covariance)
        sources = [name for name in blocks if name in self.sensors or name == "gps"]
        return Fused(path, np.exp(states.scale), {name: blocks[name].weight for name in sources})

    # --- factors

    def _normal(self, states: _States) -> tuple[F64, F64, F64]:
        """Normal equations: blocks (N, STATE_SIZE, STATE_SIZE) on and above the diagonal; gradient (N, STATE_SIZE)."""
        n = len(self.times)
        D, above = np.zeros((n, STATE_SIZE, STATE_SIZE)), np.zeros((n - 1, STATE_SIZE, STATE_SIZE))
        g = np.zeros((n, STATE_SIZE))
        for r, J, K, at, weight, _ in self._blocks(states).values():
            Jw = (J * weight[:, None, None]).transpose(0, 2, 1)
            D[at] += Jw @ J
            g[at] += np.einsum("kam,km->ka", Jw, r)
            if K is not None:
                Kw = (K * weight[:, None, None]).transpose(0, 2, 1)
                D[at + 1] += Kw @ K
                g[at + 1] += np.einsum("kam,km->ka", Kw, r)
                above[at] += Jw @ K
        return D, above, g

    def _blocks(self, states: _States) -> dict[str, _Block]:
        """All factors, by kind."""
        blocks = {name: self._relative_motions(name, states) for name in self.sensors}
        blocks["speed"] = self._speed_prior(states)
        blocks["first"] = self._first_pose_prior(states)
        only_first = np.zeros(1, np.int64)
        prior = _jacobian_of(SCALE, 1 / MODEL.initial_scale_sigma)[None]
        blocks["unit"] = _squared(states.scale[:1, None] / MODEL.initial_scale_sigma, prior, None, only_first)
        length = np.maximum(np.linalg.norm(np.diff(states.poses[:, :3, 3], axis=0), axis=1), 0.1)
        drift = MODEL.scale_drift * np.sqrt(length / 10)
        blocks["scale"] = self._random_walk(states.scale[:, None], SCALE, np.ones(len(length)), drift[:, None])
        sigma = np.ones(3) if self.fixes is None else self.fixes.bias * np.array([1, 1, MODEL.height_factor])
        decay = np.exp(-self.seconds / (60.0 if self.fixes is None else self.fixes.bias_time))
        noise = np.sqrt(1 - decay**2 + 1e-12)[:, None] * sigma
        blocks["bias"] = self._random_walk(states.bias, BIAS, decay, noise)
        blocks["bias.first"] = _squared(states.bias[:1] / sigma, _jacobian_of(BIAS, 1 / sigma)[None], None, only_first)
        if self.fixes is not None:
            blocks["gps"] = self._gps_fixes(states, self.fixes)
        if self.attitude is not None:
            blocks["attitude"] = self._attitude(states, self.attitude)
        return blocks

    def _links(self, states: _States, links: Links) -> _Block:
        """Relative poses of any two states."""
        r, by_pose = relative_pose_error(states.poses[links.first], states.poses[links.second], links.T)
        W = np.linalg.inv(np.linalg.cholesky(links.covariance))
        J, K = np.zeros((2, len(r), 6, STATE_SIZE))
        J[:, :, POSE], K[:, :, POSE] = W @ by_pose[:, 0], W @ by_pose[:, 1]
        return _robust(np.einsum("kab,kb->ka", W, r), J, K, links.first)

    def _attitude(self, states: _States, rotations: F64) -> _Block:
        """An INS's attitude: each pose counts as a share of one measurement per correlation time."""
        correlated = min(len(rotations), MODEL.attitude_time / max(float(np.median(self.seconds)), 1e-9))
        sigma = np.sqrt(max(correlated, 1.0)) * np.array(MODEL.attitude_sigma)[[0, 0, 1]]
        r = log_so3(states.poses[:, :3, :3] @ rotations.transpose(0, 2, 1)) / sigma
        J = np.zeros((len(r), 3, STATE_SIZE))
        J[:, np.arange(3), np.arange(3, 6)] = 1 / sigma
        return _squared(r, J, None, np.arange(len(r)))

    def _relative_motions(self, name: str, states: _States) -> _Block:
        """Relative motions of a sensor mounted beside the scanner."""
        motions, own = self.sensors[name]
        sensor, measured = states.poses @ own, motions.T.copy()
        if name == "camera":
            measured[:, :3, 3] *= np.exp(states.scale[:-1, None])
        r, by_sensor = relative_pose_error(sensor[:-1], sensor[1:], measured)
        lever = lever_arm_jacobian(sensor[:, :3, 3] - states.poses[:, :3, 3])
        J, K = np.zeros((2, len(r), 6, STATE_SIZE))
        J[:, :, POSE], K[:, :, POSE] = by_sensor[:, 0] @ lever[:-1], by_sensor[:, 1] @ lever[1:]
        if name == "camera":
            J[:, :3, 6] = -np.einsum("kba,kb->ka", measured[:, :3, :3], measured[:, :3, 3])
        W = self._whiten[name]
        block = _robust(np.einsum("kab,kb->ka", W, r), W @ J, W @ K, np.arange(len(r)))
        if name != "lidar":  # unsure motions of other sensors are extrapolated: they don't count
            block = block._replace(weight=block.weight * motions.sure, cost=block.cost * motions.sure)
        return block

    def _speed_prior(self, states: _States) -> _Block:
        """Weak prior of a small motion, where no sensor measured one."""
        t, R = states.poses[:, :3, 3], states.poses[:, :3, :3]
        sigma = self.seconds[:, None] * np.repeat(MODEL.speed_sigma, 3)
        r = np.concatenate([t[1:] - t[:-1], log_so3(R[1:] @ R[:-1].transpose(0, 2, 1))], axis=1) / sigma
        K = np.zeros((len(r), 6, STATE_SIZE))
        K[:, np.arange(6), np.arange(6)] = 1 / sigma
        return _squared(r, -K, K, np.arange(len(r)))

    def _first_pose_prior(self, states: _States) -> _Block:
        """Prior of the first pose: fixed; with GPS, only upright."""
        T, origin = states.poses[0], self._origin
        sigma = np.repeat(MODEL.origin_sigma, 3)
        if self.fixes is not None or self.attitude is not None:
            sigma = np.array(
                [*3 * [MODEL.unknown_sigma], MODEL.upright_sigma, MODEL.upright_sigma, MODEL.unknown_sigma]
            )
        r = np.concatenate([T[:3, 3] - origin[:3, 3], log_so3(T[:3, :3] @ origin[:3, :3].T)]) / sigma
        J = np.zeros((1, 6, STATE_SIZE))
        J[0, np.arange(6), np.arange(6)] = 1 / sigma
        return _squared(r[None], J, None, np.zeros(1, np.int64))

    def _random_walk(self, value: F64, part: slice, decay: F64, sigma: F64) -> _Block:
        """A part (N, M) of the state is `decay` (L,) times its previous value, plus noise of `sigma` (L, M)."""
        r = (value[1:] - decay[:, None] * value[:-1]) / sigma
        J, K = np.zeros((*r.shape, STATE_SIZE)), np.zeros((*r.shape, STATE_SIZE))
        J[:, :, part] = -decay[:, None, None] * (np.eye(r.shape[1]) / sigma[:, :, None])
        K[:, :, part] = np.eye(r.shape[1]) / sigma[:, :, None]
        return _squared(r, J, K, np.arange(len(r)))

    def _gps_fixes(self, states: _States, fixes: GpsFixes) -> _Block:
        at = np.flatnonzero(np.isfinite(fixes.positions[:, 0]))
        sigma = fixes.scatter * np.array([1, 1, MODEL.height_factor])
        r = (states.poses[at, :3, 3] + states.bias[at] - fixes.positions[at]) / sigma
        J = np.zeros((len(at), 3, STATE_SIZE))
        J[:, np.arange(3), np.arange(3)] = J[:, np.arange(3), np.arange(7, 10)] = 1 / sigma
        return _robust(r, J, None, at)


def _squared(residual: F64, J: F64, K: F64 | None, at: I64) -> _Block:
    """Factors with a squared loss."""
    return _Block(residual, J, K, at, np.ones(len(at)), (residual**2).sum(axis=1))


def _robust(residual: F64, J: F64, K: F64 | None, at: I64) -> _Block:
    """Factors with a Cauchy loss, which down-weights those that contradict the others."""
    scale = MODEL.cauchy_scale * residual.shape[1]
    weight = cauchy_weights(residual, scale)
    return _Block(residual, J, K, at, weight, -scale * np.log(weight))


def _jacobian_of(part: slice, value: F64 | float) -> F64:
    """(M, STATE_SIZE) Jacobian that is `value` on the diagonal of a part of the state."""
    out = np.zeros((part.stop - part.start, STATE_SIZE))
    out[:, part] = np.eye(part.stop - part.start) * value
    return out
