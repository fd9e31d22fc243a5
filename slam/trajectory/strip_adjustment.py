"""Strip adjustment: a smooth correction of a scanner's path, by which surfaces scanned at different times agree.

An INS drifts: within metres, its poses are smooth but bend; between two passes of a place, they differ by its GNSS's
error. Registered pairs of sweeps (`scan_pairs`) measure both, and the factor graph (`fusion`) distributes them over the
path: the relative motions remain those of the INS where no pair contradicts, the position and the tilt on average too.
Cf. Glira et al., "Rigorous strip adjustment of UAV-based laserscanning data", ISPRS Annals 2016.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.slam import scan_pairs
from scan2sim.slam.geometry import exp_so3, inverse, log_so3
from scan2sim.slam.scan_pairs import Pairs
from scan2sim.slam.trajectory.fusion import GpsFixes, Links, RelativeMotions, fuse

PoseSource = Literal["given", "auto", "fused"]


@dataclass(frozen=True)
class AdjustmentModel:
    """Limits and noise model of the adjustment."""

    tolerance_m: float = 0.03
    """Displacement of a typical pair up to which a path agrees with its sweeps."""
    gain_max: float = 0.7
    """Ratio of the corrected path's displacement to the given one's, above which the given path is kept."""
    unsure_m: float = 0.06
    """Displacement of a pair after the adjustment above which the path is unsure there."""
    sample: int = 60
    """Number of sweeps whose pairs decide whether an adjustment is needed."""
    pairs_min: int = 3
    """Least number of pairs that a decision needs."""
    convention_pairs: int = 8
    """Number of pairs by which conventions of the poses are compared."""
    convention_m: float = 0.2
    """Displacement of pairs from which another convention of the poses is tried."""
    rounds_max: int = 3
    """Largest number of adjustments; each registers the pairs again, deskewed by the last path."""
    converged_m: float = 0.01
    """Largest shift of a pose by the last adjustment at which no other one follows."""
    position_sigma_m: float = 0.003
    """Least standard deviation of a given relative motion's position."""
    rotation_sigma: float = 0.0007
    """Standard deviation of a given relative motion's rotation, radians."""
    drift_min: float = 0.005
    """Least standard deviation of a given relative motion's position, as a share of its length."""
    gap_sigma: tuple[float, float] = (1.0, 0.02)
    """Standard deviation of a motion over a gap of the path: metres, radians."""
    gnss_sigma_min_m: float = 0.05
    """Least error of a given position."""
    bias_time: float = 60.0
    """Correlation time of the positions' error, seconds."""
    scatter_share: float = 0.1
    """Independent error of the positions, as a share of the correlated one."""


MODEL = AdjustmentModel()


@dataclass(frozen=True)
class Agreement:
    """How well a path agrees with its sweeps.

    Attributes:
        neighbours, passes: median displacement of surfaces (m) of sweeps a few metres apart on the path, and of
            different passes; None without such pairs.
        neighbour_pairs, pass_pairs: their numbers.
    """

    neighbours: float | None
    passes: float | None
    neighbour_pairs: int
    pass_pairs: int

    @classmethod
    def of(cls, pairs: Pairs) -> Agreement:
        """Agreement of compared pairs."""

        def median(some: Bools) -> float | None:
            return float(np.median(pairs.displacement[some])) if some.sum() >= MODEL.pairs_min else None

        neighbours = ~pairs.passes
        return cls(median(neighbours), median(pairs.passes), int(neighbours.sum()), int(pairs.passes.sum()))

    @property
    def known(self) -> bool:
        """Whether there are enough pairs for a decision."""
        return self.neighbours is not None or self.passes is not None

    def within(self, tolerance: float) -> bool:
        """Whether surfaces agree to `tolerance` metres."""
        return max(self.neighbours or 0.0, self.passes or 0.0) < tolerance

    def figures(self) -> dict[str, float | int | None]:
        """Medians in metres and numbers of pairs, for the report."""
        values = {"neighbours_m": self.neighbours, "passes_m": self.passes}
        rounded = {name: None if value is None else round(value, 4) for name, value in values.items()}
        return {**rounded, "neighbour_pairs": self.neighbour_pairs, "pass_pairs": self.pass_pairs}

    def text(self, data: str = "sweeps") -> str:
        """Such as "1.2 cm (sweeps a few metres apart), 19.8 cm (passes)"; `data`: what is compared."""
        values = ((self.neighbours, f"{data} a few metres apart"), (self.passes, "different passes"))
        return ", ".join(f"{100 * value:.1f} cm ({name})" for value, name in values if value is not None)


@dataclass(frozen=True)
class Adjusted:
    """Result of `adjust`.

    Attributes:
        poses: (N, 4, 4) scanner to world at the sweeps' times; the given ones if they are kept.
        source: "given" or "fused".
        before, after: agreement of the given poses, and of the fused ones (None if they weren't estimated).
        unsure: (N,) whether sweeps near a pose still disagree.
        shift_m: median length of the correction, metres; 0 if there is none.
        failure: why the check failed unexpectedly; "" if it didn't.
        data: what is compared: "sweeps", or "sections" of an assembled cloud.
    """

    poses: F64
    source: Literal["given", "fused"]
    before: Agreement
    after: Agreement | None
    unsure: Bools
    shift_m: float = 0.0
    failure: str = ""
    data: Literal["sweeps", "sections"] = "sweeps"

    def figures(self, times: F64) -> dict[str, Any]:
        """Content of a `trajectory_check.json`; `times` (N,) in seconds."""
        edges = np.diff(np.concatenate([[False], self.unsure, [False]]).astype(int))
        spans = zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1, strict=True)
        return {
            "pose_source": self.source,
            "summary": self.summary(),
            "warnings": self.warnings(),
            "before": self.before.figures(),
            "after": None if self.after is None else self.after.figures(),
            "typical_correction_m": round(self.shift_m, 4),
            "unsure_s": [[round(float(times[first]), 3), round(float(times[last]), 3)] for first, last in spans],
        }

    def warnings(self) -> list[str]:
        """What a user should know about the poses."""
        if self.failure:
            return [f"the poses couldn't be checked against the {self._whole} ({self.failure}): they are used as given"]
        if not self.before.known:
            return []
        if self.source == "given" and not self.before.within(MODEL.tolerance_m):
            remedy = "check their time stamps, the extrinsics and --deskew"
            if self.data == "sections":
                remedy = "check the times of the points and of the trajectory"
            if self.after is None:
                remedy = "--pose-source auto corrects them"
            return [f"the poses contradict the {self._whole}: surfaces disagree by {self._text(self.before)}; {remedy}"]
        if self.unsure.any():
            share = f"{100 * self.unsure.mean():.0f} %"
            return [
                f"surfaces still disagree by more than {100 * MODEL.unsure_m:.0f} cm at {share} of the {self.data}: "
                "trajectory_check.json lists their times"
            ]
        return []

    def summary(self) -> str:
        """A sentence for the report."""
        if self.failure:
            return f"poses as given, not checked: {self.failure}"
        if not self.before.known:
            return f"poses as given: the {self.data} overlap too little to check them, or their poses are implausible"
        if self.after is None:
            return f"poses as given: surfaces agree to {self._text(self.before)}"
        if self.source == "given":
            return (
                f"poses as given: surfaces disagree by {self._text(self.before)}, "
                f"and matching the {self.data} doesn't improve it ({self._text(self.after)})"
            )
        return (
            f"poses corrected by matching the {self.data}: surfaces disagreed by {self._text(self.before)}, now by "
            f"{self._text(self.after)}; typical correction {100 * self.shift_m:.0f} cm"
        )

    @property
    def _whole(self) -> str:
        return "cloud" if self.data == "sections" else self.data

    def _text(self, agreement: Agreement) -> str:
        return agreement.text(self.data)


def adjust(
    times: F64,
    poses: F64,
    sweep: Callable[[int, ScannerPath], F64],
    source: PoseSource = "auto",
    *,
    sigma: float = MODEL.gnss_sigma_min_m,
    after_gap: Bools | None = None,
    report: Report,
) -> Adjusted:
    """Check the poses of sweeps against their surfaces, and correct them where the surfaces allow.

    An unexpected failure of the check costs nothing else: unless a correction is required ("fused"), the given poses
    are kept, with a warning.

    Args:
        times: (N,) seconds of the sweeps.
        poses: (N, 4, 4) scanner to world, local coordinates.
        sweep: points (M, 3) of a sweep in scanner axes at its time, deskewed by a path of the scanner, by index.
        source: "given" only checks; "auto" corrects poses that disagree if that improves them clearly; "fused" always
            corrects them.
        sigma: standard deviation of the positions, metres.
        after_gap: (N,) whether the path has a gap between a sweep and the previous one: the motion is unknown.
        report: receives progress.

    Raises:
        ScanError: a sweep can't be read.
    """
    try:
        return _adjusted(times, poses, sweep, source, sigma, after_gap, report)
    except ScanError:
        raise
    except Exception as error:  # the check must not cost the import
        if source == "fused":
            raise
        return unchecked(poses, f"{type(error).__name__}: {error}")


def _adjusted(
    times: F64,
    poses: F64,
    sweep: Callable[[int, ScannerPath], F64],
    source: PoseSource,
    sigma: float,
    after_gap: Bools | None,
    report: Report,
) -> Adjusted:
    none = np.zeros(len(times), bool)
    travelled = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    all_keys = scan_pairs.MODEL.key_spacing_m
    every = max(all_keys, travelled / MODEL.sample)
    pairs = _compare(times, poses, sweep, every, lambda f, text="": report(0.2 * f, text))
    before = Agreement.of(pairs)
    if not before.known or source == "given" or (source == "auto" and before.within(MODEL.tolerance_m)):
        return Adjusted(poses, "given", before, None, none)
    best = poses
    if every > all_keys:
        pairs = _compare(times, poses, sweep, all_keys, lambda f, text="": report(0.2 + 0.2 * f, text))
    drift = max(MODEL.drift_min, (Agreement.of(pairs).neighbours or 0.0) / scan_pairs.MODEL.neighbour_spacing_m)
    for number in range(MODEL.rounds_max):
        last, best = best, _fused(times, poses, pairs, drift, sigma, after_gap)
        start = 0.4 + 0.2 * number
        pairs = _compare(times, best, sweep, all_keys, lambda f, text="", start=start: report(start + 0.2 * f, text))
        if np.linalg.norm((best - last)[:, :3, 3], axis=1).max() < MODEL.converged_m:
            break
    after = Agreement.of(pairs)
    if source == "auto" and not _improves(before, after):
        return Adjusted(poses, "given", before, after, none)
    shift = float(np.median(np.linalg.norm((best - poses)[:, :3, 3], axis=1)))
    return Adjusted(best, "fused", before, after, _unsure(len(times), pairs), shift)


def disagreement(times: F64, poses: F64, sweep: Callable[[int, ScannerPath], F64]) -> float:
    """Median displacement (m) of a few pairs of neighbouring sweeps, 1 m if they can't be registered.

    Poses of another convention, unlike those of a drifting INS, disagree by decimetres.

    Args:
        times, poses, sweep: as in `adjust`.
    """
    path = ScannerPath(times, poses)
    first, second, passes = scan_pairs.select(poses[:, :3, 3])
    some = np.flatnonzero(~passes)
    some = some[:: max(1, len(some) // MODEL.convention_pairs)]
    if not len(some):
        return 1.0
    pairs = scan_pairs.compare(lambda i: sweep(i, path), poses, first[some], second[some], passes[some])
    return float(np.median(np.concatenate([pairs.displacement, np.ones(len(some) - len(pairs))])))


def unchecked(poses: F64, failure: str = "") -> Adjusted:
    """Given poses (N, 4, 4) that can't be checked, or whose check failed unexpectedly."""
    none = np.zeros(len(poses), bool)
    return Adjusted(poses, "given", Agreement(None, None, 0, 0), None, none, failure=failure)


def _compare(times: F64, poses: F64, sweep: Callable[[int, ScannerPath], F64], every_m: float, report: Report) -> Pairs:
    path = ScannerPath(times, poses)
    return scan_pairs.compare(
        lambda i: sweep(i, path), poses, *scan_pairs.select(poses[:, :3, 3], every_m), report=report
    )


def _fused(times: F64, poses: F64, pairs: Pairs, drift: float, sigma: float, after_gap: Bools | None) -> F64:
    """Poses (N, 4, 4) in which given relative motions and registered pairs agree as well as their errors allow.

    Args:
        times, poses: the given ones.
        pairs: registered pairs.
        drift: error of a relative motion as a share of its length.
        sigma: standard deviation of the positions, metres.
        after_gap: as in `adjust`.
    """
    T = inverse(poses[:-1]) @ poses[1:]
    length = np.linalg.norm(T[:, :3, 3], axis=1)
    position = MODEL.position_sigma_m**2 + (drift * length) ** 2
    variance = np.stack([position, np.full(len(T), MODEL.rotation_sigma**2)], axis=1)
    if after_gap is not None:
        variance[after_gap[1:]] += np.square(MODEL.gap_sigma)
    given = RelativeMotions(T, np.repeat(variance, 3, axis=1)[:, :, None] * np.eye(6), np.ones(len(T), bool))
    seconds = max(float(np.median(np.diff(times))), 1e-6)
    # the random walk of the positions' error follows a drift as fast as the measured one
    walk = float(np.median(length)) * drift
    bias = max(sigma, walk / np.sqrt(2 * min(1.0, seconds / MODEL.bias_time)))
    smoothed = np.sqrt(max(1.0, 2.0 / seconds))
    fixes = GpsFixes(poses[:, :3, 3], MODEL.scatter_share * bias * smoothed, bias, MODEL.bias_time)
    links = Links(pairs.first, pairs.second, pairs.T, pairs.covariance)
    found = fuse(times, ins=given, attitude=poses[:, :3, :3], fixes=fixes, links=links, first=poses[0])
    return found.trajectory.poses


def _improves(before: Agreement, after: Agreement) -> bool:
    """Whether surfaces agree clearly better, and none of the two kinds of pairs worse."""
    ratios = []
    for old, new in ((before.neighbours, after.neighbours), (before.passes, after.passes)):
        if old is not None and new is not None:
            ratios.append(new / max(old, 1e-9))
            if new > max(old, MODEL.tolerance_m):
                return False
    return bool(ratios) and min(ratios) < MODEL.gain_max


def _unsure(count: int, pairs: Pairs) -> Bools:
    """(N,) sweeps between the two of a pair of neighbours that still disagree, or one of a pair of passes."""
    out = np.zeros(count, bool)
    for k in np.flatnonzero(pairs.displacement > MODEL.unsure_m):
        first = pairs.second[k] if pairs.passes[k] else pairs.first[k]
        out[first : pairs.second[k] + 1] = True
    return out


def corrected(times: F64, poses: F64, at: F64, given: F64, adjusted: F64) -> F64:
    """Poses (T, 4, 4) of a path after a correction that is known at some times; between them it is interpolated.

    Args:
        times: (T,) seconds of the path.
        poses: (T, 4, 4) its poses.
        at: (N,) seconds of the corrected poses.
        given, adjusted: (N, 4, 4) poses at these times, before and after the correction.
    """
    shift, turn = correction(given, adjusted)
    out = poses.copy()
    for k in range(3):
        out[:, k, 3] += np.interp(times, at, shift[:, k])
    rotation = np.stack([np.interp(times, at, turn[:, k]) for k in range(3)], axis=1)
    out[:, :3, :3] = exp_so3(rotation) @ poses[:, :3, :3]
    return out


def correction(given: F64, adjusted: F64) -> tuple[F64, F64]:
    """Shifts (N, 3) in metres and rotation vectors (N, 3) in radians, world axes, from given to adjusted poses."""
    turn = log_so3(adjusted[:, :3, :3] @ given[:, :3, :3].transpose(0, 2, 1))
    return adjusted[:, :3, 3] - given[:, :3, 3], turn
