"""Evaluation of trajectories: the two errors of D3.2 (section 4.1), and the usual ones (ATE, RPE, KITTI).

Those of D3.2 are computed in the ground plane (x, y; both trajectories z-up): the estimate is rotated, scaled and moved
onto the truth by least squares; the mean distance along the path is the *global mean error*. Segments of 400 m of the
aligned path are then rotated and moved so that their end points coincide with those of the truth; the median of the
distances at their midpoints is the *local median error 400*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, I64, GpsTrack, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.trajectory import atomic_write
from scan2sim.slam.trajectory.gps import noise, smooth

AlignmentKind = Literal["similarity2d", "rigid2d", "similarity3d"]

SEGMENT_M = 400.0  # length of the local error's segments, D3.2
SEGMENT_SPACING_M = 5.0  # between the starts of segments
RPE_DISTANCE_M = 10.0  # distance over which the relative pose error is measured
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_POSE_STEP = 10  # poses between the starts of KITTI's segments
LENGTH_SMOOTHING_S = 2.0  # smoothing of a GPS track before its length is measured
STRIDE_M = 1.0  # shorter moves don't count as distance; otherwise the noise of a standing receiver would add up
STRIDES_PER_EXTENT = 50  # of a path within a room, such as a hand-held one, whose truth has no such noise
MIN_CHORD_M, CHORD_SHARE = 1.0, 0.1  # segments whose truth returns to its start have no direction


@dataclass(frozen=True)
class RelativeError:
    """Error of relative motions.

    Attributes:
        translation: unit as documented in the field of `Evaluation`.
        rotation_deg_per_m: degrees per metre driven; None if rotations are unknown.
    """

    translation: float
    rotation_deg_per_m: float | None


@dataclass(frozen=True)
class Evaluation:
    """Result of `evaluate`, in metres; None where the path is too short, or the value unknown.

    Attributes:
        global_mean: mean distance in the ground plane after alignment.
        drift_percent: `global_mean` in per cent of the length of the path.
        local_median: median error at the midpoints of segments of `segment` m whose ends are aligned with the truth's.
        segment: length of the segments, metres.
        alignment: transform that aligns the estimate with the truth.
        scale: scale of that transform.
        ate_similarity, ate_rigid: root mean square 3D distance after a 3D similarity, and rigid, alignment.
        rpe: relative pose error over 10 m; translation: root mean square error in metres.
        rpe_frame: relative pose error from pose to pose; translation: root mean square error in metres.
        kitti: KITTI's error over 100 to 800 m; translation: mean error in per cent of the distance.
        length: distance that the truth moved in the ground plane while there was an estimate, metres.
        coverage: `length` as a share of the length of the whole truth.
        truth_noise: the truth's own error, standard deviation of an axis, metres; a lower bound if it was estimated.
        times: (N,) seconds of the compared poses.
        distance: (N,) metres along the truth.
        path, truth: (N, 2) aligned estimate and truth, ground plane.
        errors: (N,) their distances.
        local_at, local_errors: (S,) metres along the truth of the segments' midpoints, and their errors.
    """

    global_mean: float
    drift_percent: float
    local_median: float | None
    segment: float
    alignment: AlignmentKind
    scale: float
    ate_similarity: float
    ate_rigid: float
    rpe: RelativeError | None
    rpe_frame: RelativeError | None
    kitti: RelativeError | None
    length: float
    coverage: float
    truth_noise: float | None
    times: F64
    distance: F64
    path: F64
    truth: F64
    errors: F64
    local_at: F64
    local_errors: F64

    def figures(self) -> dict[str, float | None]:
        """Metrics for reports, by name and unit."""
        return {
            "global_mean_m": self.global_mean,
            "drift_percent": self.drift_percent,
            f"local_median_{self.segment:g}_m": self.local_median,
            "ate_similarity_m": self.ate_similarity,
            "ate_rigid_m": self.ate_rigid,
            **_relative_figures("rpe_10m", "m", self.rpe),
            **_relative_figures("rpe_frame", "m", self.rpe_frame),
            **_relative_figures("kitti", "percent", self.kitti),
            "scale": self.scale,
            "length_m": self.length,
            "coverage": self.coverage,
            "truth_noise_m": self.truth_noise,
            "poses": float(len(self.times)),
        }


def read_truth(path: Path) -> Trajectory | GpsTrack:
    """Read a reference trajectory in any of the supported formats, or a GPS track.

    Raises:
        InputError: the file is neither, or can't be read.
    """
    if path.suffix.lower() in (".gpx", ".nmea", ".mp4"):
        return gps_io.read(path)
    if path.suffix.lower() == ".csv" and "lat" in path.read_text(encoding="utf-8", errors="replace")[:200]:
        return gps_io.read(path)
    return trajectory_io.read(path)


def evaluate(
    estimate: Trajectory,
    truth: Trajectory | GpsTrack,
    *,
    segment: float = SEGMENT_M,
    step: float = SEGMENT_SPACING_M,
    alignment: AlignmentKind = "similarity2d",
    by: Literal["time", "index"] = "time",
    truth_noise: float | None = None,
) -> Evaluation:
    """Compare a trajectory with ground truth: another trajectory, or a GPS track.

    Args:
        estimate: z-up, or in any orientation with "similarity3d".
        truth: z-up, metres; if it has rotations, they must be of the same sensor axes. A GPS track is used unchanged,
            so that its noise adds to the errors: smooth it first (`slam.trajectory.gps.smooth`) if that matters.
        segment: length of the local error's segments, metres.
        step: metres between their starts.
        alignment: "similarity2d" as in D3.2; "rigid2d" keeps the estimate's scale; "similarity3d" also levels it. All
            errors except `ate_similarity` and `ate_rigid` are computed after this alignment.
        by: "time" interpolates the truth at the estimate's times, excluding its gaps; "index" compares pose by pose,
            for files without times.
        truth_noise: metres, if known; estimated for a GPS track by default (`slam.trajectory.gps.noise`).

    Raises:
        DataError: fewer than three common poses, NaN, or an estimate that doesn't move.
    """
    times, index, true_positions = _associate(estimate, truth, by)
    positions = estimate.positions[index]
    if not np.isfinite(positions).all() or not np.isfinite(true_positions).all():
        raise DataError("trajectory", "contains NaN positions", "Remove the poses without a position")
    dimensions = 3 if alignment == "similarity3d" else 2
    onto = umeyama(positions[:, :dimensions], true_positions[:, :dimensions], scaled=alignment != "rigid2d")
    path, ground = onto.apply(positions[:, :dimensions])[:, :2], true_positions[:, :2]
    whole_length, distance = _truth_lengths(truth, ground, times)
    errors = np.linalg.norm(path - ground, axis=1)
    local_at, local_errors = segment_errors(path, ground, distance, segment, step)
    rotations = _rotations(estimate, truth, times, index, by)
    if truth_noise is None and isinstance(truth, GpsTrack):
        truth_noise = noise(truth)
    frames = np.arange(len(times))
    both = positions * onto.scale, true_positions
    return Evaluation(
        global_mean=float(errors.mean()),
        drift_percent=float(100 * errors.mean() / distance[-1]),
        local_median=float(np.median(local_errors)) if len(local_errors) else None,
        segment=segment,
        alignment=alignment,
        scale=onto.scale,
        ate_similarity=_rms(umeyama(positions, true_positions, scaled=True).apply(positions) - true_positions),
        ate_rigid=_rms(umeyama(positions, true_positions, scaled=False).apply(positions) - true_positions),
        rpe=_relative_error(both, rotations, distance, *_pairs(distance, frames, RPE_DISTANCE_M)),
        rpe_frame=_relative_error(both, rotations, distance, frames[:-1], frames[1:]),
        kitti=_kitti_error(both, rotations, distance),
        length=float(distance[-1]),
        coverage=float(distance[-1] / whole_length),
        truth_noise=truth_noise,
        times=times,
        distance=distance,
        path=path,
        truth=ground,
        errors=errors,
        local_at=local_at,
        local_errors=local_errors,
    )


def stride_of(ground: F64) -> float:
    """Stride in metres for the length of a path (N, 2): `STRIDE_M`, or less if the whole path is within a room."""
    extent = float(np.linalg.norm(np.ptp(ground, axis=0)))
    return min(STRIDE_M, extent / STRIDES_PER_EXTENT)


def distance_along(ground: F64, stride: float = STRIDE_M) -> F64:
    """(N,) metres travelled along positions (N, 2), measured in strides of `stride` metres: jitter doesn't add up."""
    kept = [0]
    points = ground.tolist()
    x, y = points[0]
    for i, (u, v) in enumerate(points):
        if (u - x) ** 2 + (v - y) ** 2 >= (stride - 1e-9) ** 2:
            kept.append(i)
            x, y = u, v
    if kept[-1] != len(points) - 1:
        kept.append(len(points) - 1)
    strides = np.linalg.norm(np.diff(ground[kept], axis=0), axis=1)
    return np.interp(np.arange(len(points)), kept, np.concatenate([[0.0], np.cumsum(strides)]))


def segment_errors(
    path: F64, truth: F64, distance: F64, segment: float = SEGMENT_M, step: float = SEGMENT_SPACING_M
) -> tuple[F64, F64]:
    """Errors at the midpoints of segments whose end points are aligned with the truth's.

    Rotation and translation bring a segment's two ends nearest to the truth's: the chords' midpoints and directions
    coincide. Segments whose truth ends within 1 m (or a tenth of a shorter segment) of its start have no direction and
    are excluded.

    Args:
        path, truth: (N, 2) metres, ground plane.
        distance: (N,) metres along the truth.
        segment: length of the segments, metres.
        step: metres between their starts.

    Returns:
        (S,) metres along the truth of the midpoints, and (S,) errors in metres.
    """
    starts = np.arange(0.0, distance[-1] - segment + 1e-6, step)
    midpoints, chords = [], []
    for points in (path @ (1, 1j), truth @ (1, 1j)):  # the plane as complex numbers
        start, middle, end = (np.interp(starts + share * segment, distance, points) for share in (0.0, 0.5, 1.0))
        chords.append(end - start)
        midpoints.append(middle - (start + end) / 2)
    turn = chords[1] * np.conj(chords[0])
    valid = (np.abs(chords[1]) > min(MIN_CHORD_M, CHORD_SHARE * segment)) & (np.abs(turn) > 0)
    turned = midpoints[0][valid] * turn[valid] / np.abs(turn[valid])
    return starts[valid] + segment / 2, np.abs(turned - midpoints[1][valid])


def plot(evaluation: Evaluation, file: Path) -> None:
    """Write a PNG: the aligned path over the truth, and the errors along it.

    Raises:
        UnavailableError: matplotlib isn't installed.
    """
    require("a plot", "matplotlib")
    from matplotlib.figure import Figure

    e = evaluation
    blue, amber = "#1f5fbf", "#f0a818"
    figure = Figure(figsize=(13, 6), dpi=110, layout="constrained")
    ground, along = figure.subplots(1, 2, width_ratios=(1, 1.1))
    middle = e.truth.mean(axis=0)
    ground.plot(*(e.truth - middle).T, color=amber, linewidth=4, label="truth")
    ground.plot(*(e.path - middle).T, color=blue, linewidth=1.4, label="estimate")
    ground.plot(*(e.truth[0] - middle), "o", color="black", markersize=5, label="start")
    ground.set_aspect("equal", adjustable="datalim")
    ground.set(
        xlabel="east, m", ylabel="north, m", title=f"{e.length / 1000:.2f} km, {e.alignment}, scale {e.scale:.4f}"
    )
    along.plot(e.distance, e.errors, color=blue, linewidth=1.2, label=f"global: mean {e.global_mean:.2f} m")
    if e.local_median is not None:
        name = f"local {e.segment:g} m: median {e.local_median:.2f} m"
        along.plot(e.local_at, e.local_errors, color="#c2410c", linewidth=1.2, label=name)
    if e.truth_noise:
        along.axhline(e.truth_noise, color="grey", linestyle=":", label=f"noise of the truth {e.truth_noise:.2f} m")
    along.set(xlabel="along the path, m", ylabel="error, m", title=f"global mean {e.drift_percent:.3f} % of the path")
    along.set_ylim(bottom=0)
    for axes in (ground, along):
        axes.grid(alpha=0.3)
        axes.legend()
    with atomic_write(file) as fresh:
        figure.savefig(fresh, format="png")


def _relative_figures(name: str, unit: str, error: RelativeError | None) -> dict[str, float | None]:
    return {
        f"{name}_{unit}": None if error is None else error.translation,
        f"{name}_deg_per_m": None if error is None else error.rotation_deg_per_m,
    }


def _associate(estimate: Trajectory, truth: Trajectory | GpsTrack, by: str) -> tuple[F64, I64, F64]:
    """Common poses: (N,) times, (N,) indices in the estimate, and (N, 3) positions of the truth."""
    if by == "index":
        if len(estimate) != len(truth):
            raise DataError(
                "trajectory", f"has {len(estimate)} poses, the truth {len(truth)}", "Compare by time instead"
            )
        index, positions = np.arange(len(truth)), truth.positions
    elif isinstance(truth, GpsTrack):
        positions = truth.at(estimate.times)
        index = np.flatnonzero(np.isfinite(positions).all(axis=1))
        positions = positions[index]
    else:
        index = np.flatnonzero((estimate.times >= truth.times[0]) & (estimate.times <= truth.times[-1]))
        positions = truth.at(estimate.times[index])
    if len(index) < 3:
        span = [f"{t.times[0]:.1f} to {t.times[-1]:.1f} s" if len(t) else "nothing" for t in (estimate, truth)]
        raise DataError(
            "trajectory",
            f"has {len(index)} poses in common with the truth (it spans {span[0]}, the truth {span[1]})",
            "Shift the truth to the video's clock, or compare by index",
        )
    return estimate.times[index], index, positions


def _truth_lengths(truth: Trajectory | GpsTrack, ground: F64, times: F64) -> tuple[float, F64]:
    """Length of the whole truth, and (N,) distance along it at `times`, metres; a GPS track is smoothed first."""
    if isinstance(truth, GpsTrack):
        truth = smooth(truth, LENGTH_SMOOTHING_S)
        ground, stride = truth.at(times)[:, :2], STRIDE_M
    else:
        stride = stride_of(truth.positions[:, :2])
    return float(distance_along(truth.positions[:, :2], stride)[-1]), distance_along(ground, stride)


def _rotations(
    estimate: Trajectory, truth: Trajectory | GpsTrack, times: F64, index: I64, by: str
) -> tuple[F64, F64] | None:
    """(N, 3, 3) rotations of the estimate and of the truth; None if either has none."""
    if isinstance(truth, GpsTrack) or truth.rotations is None or estimate.rotations is None:
        return None
    return estimate.rotations[index], truth.rotations if by == "index" else truth.pose_at(times)[:, :3, :3]


def _rms(vectors: F64) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _pairs(distance: F64, starts: I64, length: float) -> tuple[I64, I64]:
    """Starts, and the first poses after more than `length` metres, of all starts that have such a pose."""
    ends = np.searchsorted(distance, distance[starts] + length, side="right")
    inside = ends < len(distance)
    return starts[inside], ends[inside]


def _motion_errors(
    positions: tuple[F64, F64], rotations: tuple[F64, F64] | None, a: I64, b: I64
) -> tuple[F64, F64 | None]:
    """(P,) errors of the motions from poses `a` to poses `b`, metres and degrees.

    With rotations: of the motion in the first pose's axes. Without: of its length.
    """
    moved = [p[b] - p[a] for p in positions]
    if rotations is None:
        return np.abs(np.linalg.norm(moved[0], axis=1) - np.linalg.norm(moved[1], axis=1)), None
    local = [np.einsum("nji,nj->ni", R[a], move) for R, move in zip(rotations, moved, strict=True)]
    turned = [R[a].transpose(0, 2, 1) @ R[b] for R in rotations]
    between = turned[1].transpose(0, 2, 1) @ turned[0]
    translation = local[0] - local[1]  # its norm is the same in any axes
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    skew = between - between.transpose(0, 2, 1)
    sine = np.sqrt((skew**2).sum(axis=(1, 2)) / 8)  # arccos alone is inaccurate near zero
    return np.linalg.norm(translation, axis=1), np.degrees(np.arctan2(sine, cosine))


def _relative_error(
    positions: tuple[F64, F64], rotations: tuple[F64, F64] | None, distance: F64, a: I64, b: I64
) -> RelativeError | None:
    """Root mean square translation error, metres, and rotation error of the motions from poses `a` to poses `b`."""
    if not len(a):
        return None
    metres, degrees = _motion_errors(positions, rotations, a, b)
    travelled = float((distance[b] - distance[a]).sum())
    rotation = None if degrees is None or travelled == 0 else float(degrees.sum() / travelled)
    return RelativeError(float(np.sqrt((metres**2).mean())), rotation)


def _kitti_error(positions: tuple[F64, F64], rotations: tuple[F64, F64] | None, distance: F64) -> RelativeError | None:
    """Errors as in KITTI's odometry benchmark: the mean over all lengths and starts."""
    starts = np.arange(0, len(distance), KITTI_POSE_STEP)
    shares: list[Any] = []
    turns: list[Any] = []
    for length in KITTI_LENGTHS_M:
        metres, degrees = _motion_errors(positions, rotations, *_pairs(distance, starts, length))
        shares.append(100 * metres / length)
        turns.append([] if degrees is None else degrees / length)
    share, turn = _mean(shares), _mean(turns)
    return None if share is None else RelativeError(share, turn)


def _mean(parts: Sequence[Any]) -> float | None:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else None
