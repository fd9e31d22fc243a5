"""How good a trajectory is: the mission's two errors (D3.2 section 4.1), and those that others report.

The mission's are taken in the ground plane (x, y; both trajectories z-up): the estimate is rotated, scaled and moved
onto the truth by least squares; the mean distance along the path is the *global mean error*. Segments of 400 m of the
aligned path are then rotated and moved so that their end points meet those of the truth; the median of the distances
in their middles is the *local median error 400*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import F64, I64, GpsTrack, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.trajectory import replacing
from scan2sim.slam.trajectory.gps import noise, smooth

AlignmentKind = Literal["similarity2d", "rigid2d", "similarity3d"]

SEGMENT = 400.0  # m, D3.2
STEP = 5.0  # m between the starts of segments
DELTA = 10.0  # m over which relative errors are taken
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10  # poses between the starts of KITTI's segments
COURSE_SECONDS = 2.0  # smoothing of a GPS track before its length is measured
STRIDE = 1.0  # m: shorter moves are not counted as way, or a standing receiver would travel


@dataclass(frozen=True)
class Relative:
    """Error of motions over some distance.

    Attributes:
        translation: as the field that holds it says.
        rotation_deg_per_m: degrees by metre of way; None where a rotation is unknown.
    """

    translation: float
    rotation_deg_per_m: float | None


@dataclass(frozen=True)
class Evaluation:
    """What `evaluate` found; metres, and None for what the path is too short for or what isn't known.

    Attributes:
        global_mean: mean distance in the ground plane after alignment.
        drift_percent: `global_mean` by the length of the path, x 100.
        local_median: median displacement in the middles of `segment` m long parts whose ends were laid on the truth's.
        segment: metres.
        alignment: how the estimate was brought onto the truth, and its `scale`.
        ate_similarity, ate_rigid: root mean square 3D distance after a 3D similarity, and rigid, alignment.
        rpe: over 10 m: translation the root mean square error in metres.
        rpe_frame: the same from pose to pose.
        kitti: over 100 to 800 m: translation the mean error in per cent of the way.
        length: metres that the truth moved in the ground plane while there was an estimate.
        coverage: `length` by the length of the whole truth.
        truth_noise: the truth's own error, one standard deviation (m) of an axis; at least, if it was measured.
        times: (N,) seconds of the poses that were compared.
        distance: (N,) metres along the truth.
        path, truth: (N, 2) aligned estimate and truth, ground plane.
        errors: (N,) their distances.
        local_at, local_errors: (S,) metres along the truth of the segments' middles, and their errors.
    """

    global_mean: float
    drift_percent: float
    local_median: float | None
    segment: float
    alignment: AlignmentKind
    scale: float
    ate_similarity: float
    ate_rigid: float
    rpe: Relative | None
    rpe_frame: Relative | None
    kitti: Relative | None
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
        """All that is a number, by name and unit, for reports."""
        return {
            "global_mean_m": self.global_mean,
            "drift_percent": self.drift_percent,
            f"local_median_{self.segment:g}_m": self.local_median,
            "ate_similarity_m": self.ate_similarity,
            "ate_rigid_m": self.ate_rigid,
            **_named("rpe_10m", "m", self.rpe),
            **_named("rpe_frame", "m", self.rpe_frame),
            **_named("kitti", "percent", self.kitti),
            "scale": self.scale,
            "length_m": self.length,
            "coverage": self.coverage,
            "truth_noise_m": self.truth_noise,
            "poses": float(len(self.times)),
        }


def read_truth(path: Path) -> Trajectory | GpsTrack:
    """What a trajectory is compared with: another in any of their formats, or a GPS track.

    Raises:
        InputError: it is neither, or can't be read.
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
    segment: float = SEGMENT,
    step: float = STEP,
    alignment: AlignmentKind = "similarity2d",
    by: Literal["time", "index"] = "time",
    truth_noise: float | None = None,
) -> Evaluation:
    """Compare a trajectory with the truth, a GPS track for example.

    Args:
        estimate: z-up, but with "similarity3d" in any orientation.
        truth: z-up, metres; its poses of the same sensor's axes, if it has rotations. A GPS track is taken as it is,
            its noise adds to the errors: smooth it first (`slam.trajectory.gps.smooth`) where that matters.
        segment: metres of the local error's parts.
        step: metres between their starts.
        alignment: "similarity2d" as in D3.2; "rigid2d" leaves the estimate its scale; "similarity3d" also levels it.
            All errors but `ate_similarity` and `ate_rigid` are of the estimate so aligned and scaled.
        by: "time" interpolates the truth at the estimate's times, leaving out where it has gaps; "index" takes pose by
            pose, for files without times.
        truth_noise: metres, if known; otherwise measured for a GPS track (`slam.trajectory.gps.noise`).

    Raises:
        DataError: fewer than three poses in common, NaN, or an estimate that doesn't move.
    """
    times, index, place = _associate(estimate, truth, by)
    found = estimate.positions[index]
    if not np.isfinite(found).all() or not np.isfinite(place).all():
        raise DataError("trajectory", "holds NaN", "Leave out what has no pose")
    dimensions = 3 if alignment == "similarity3d" else 2
    onto = umeyama(found[:, :dimensions], place[:, :dimensions], scaled=alignment != "rigid2d")
    path, ground = onto.apply(found[:, :dimensions])[:, :2], place[:, :2]
    course, distance = _course(truth, ground, times)
    errors = np.linalg.norm(path - ground, axis=1)
    local_at, local_errors = local(path, ground, distance, segment, step)
    poses = _poses(estimate, truth, times, index, by)
    if truth_noise is None and isinstance(truth, GpsTrack):
        truth_noise = noise(truth)
    frames = np.arange(len(times))
    chords = found * onto.scale, place
    return Evaluation(
        global_mean=float(errors.mean()),
        drift_percent=float(100 * errors.mean() / distance[-1]),
        local_median=float(np.median(local_errors)) if len(local_errors) else None,
        segment=segment,
        alignment=alignment,
        scale=onto.scale,
        ate_similarity=_rms(umeyama(found, place, scaled=True).apply(found) - place),
        ate_rigid=_rms(umeyama(found, place, scaled=False).apply(found) - place),
        rpe=_relative(chords, poses, distance, *_pairs(distance, frames, DELTA)),
        rpe_frame=_relative(chords, poses, distance, frames[:-1], frames[1:]),
        kitti=_kitti(chords, poses, distance),
        length=float(distance[-1]),
        coverage=float(distance[-1] / course),
        truth_noise=truth_noise,
        times=times,
        distance=distance,
        path=path,
        truth=ground,
        errors=errors,
        local_at=local_at,
        local_errors=local_errors,
    )


def way(ground: F64, stride: float = STRIDE) -> F64:
    """(N,) metres travelled along (N, 2) positions, in strides of `stride` metres: jitter of less doesn't add up."""
    anchors = [0]
    points = ground.tolist()
    x, y = points[0]
    for i, (u, v) in enumerate(points):
        if (u - x) ** 2 + (v - y) ** 2 >= (stride - 1e-9) ** 2:
            anchors.append(i)
            x, y = u, v
    if anchors[-1] != len(points) - 1:
        anchors.append(len(points) - 1)
    strides = np.linalg.norm(np.diff(ground[anchors], axis=0), axis=1)
    return np.interp(np.arange(len(points)), anchors, np.concatenate([[0.0], np.cumsum(strides)]))


def local(path: F64, truth: F64, distance: F64, segment: float = SEGMENT, step: float = STEP) -> tuple[F64, F64]:
    """Displacements in the middles of segments whose end points were laid on the truth's.

    Rotation and translation bring a segment's two ends nearest to the truth's: the middles of the chords coincide, and
    so do their directions. Segments whose truth ends within 1 m of its start have no direction and are left out.

    Args:
        path, truth: (N, 2) metres, ground plane.
        distance: (N,) metres along the truth.

    Returns:
        (S,) metres along the truth of the middles, and (S,) errors in metres.
    """
    starts = np.arange(0.0, distance[-1] - segment + 1e-6, step)
    middles, chords = [], []
    for points in (path @ (1, 1j), truth @ (1, 1j)):  # the plane as complex numbers
        start, middle, end = (np.interp(starts + share * segment, distance, points) for share in (0.0, 0.5, 1.0))
        chords.append(end - start)
        middles.append(middle - (start + end) / 2)
    turn = chords[1] * np.conj(chords[0])
    clear = (np.abs(chords[1]) > 1.0) & (np.abs(turn) > 0)
    turned = middles[0][clear] * turn[clear] / np.abs(turn[clear])
    return starts[clear] + segment / 2, np.abs(turned - middles[1][clear])


def plot(evaluation: Evaluation, file: Path) -> None:
    """Write a PNG: the aligned path over the truth, and the errors along it.

    Raises:
        UnavailableError: matplotlib isn't installed.
    """
    need("a plot", "matplotlib")
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
        along.axhline(e.truth_noise, color="grey", linestyle=":", label=f"truth's noise {e.truth_noise:.2f} m")
    along.set(xlabel="along the path, m", ylabel="error, m", title=f"global mean {e.drift_percent:.3f} % of the way")
    along.set_ylim(bottom=0)
    for axes in (ground, along):
        axes.grid(alpha=0.3)
        axes.legend()
    with replacing(file) as fresh:
        figure.savefig(fresh, format="png")


def _named(name: str, unit: str, error: Relative | None) -> dict[str, float | None]:
    return {
        f"{name}_{unit}": None if error is None else error.translation,
        f"{name}_deg_per_m": None if error is None else error.rotation_deg_per_m,
    }


def _associate(estimate: Trajectory, truth: Trajectory | GpsTrack, by: str) -> tuple[F64, I64, F64]:
    """Times of the poses that both have, their indices in the estimate, and the truth's (N, 3) positions there."""
    if by == "index":
        if len(estimate) != len(truth):
            raise DataError(
                "trajectory", f"has {len(estimate)} poses, the truth {len(truth)}", "Compare by time, or pose by pose"
            )
        index, place = np.arange(len(truth)), truth.positions
    elif isinstance(truth, GpsTrack):
        place = truth.at(estimate.times)
        index = np.flatnonzero(np.isfinite(place).all(axis=1))
        place = place[index]
    else:
        index = np.flatnonzero((estimate.times >= truth.times[0]) & (estimate.times <= truth.times[-1]))
        place = truth.at(estimate.times[index])
    if len(index) < 3:
        span = [f"{t.times[0]:.1f} to {t.times[-1]:.1f} s" if len(t) else "nothing" for t in (estimate, truth)]
        raise DataError(
            "trajectory",
            f"has {len(index)} poses in common with the truth (it spans {span[0]}, the truth {span[1]})",
            "Shift the truth to the video's clock, or compare by index",
        )
    return estimate.times[index], index, place


def _course(truth: Trajectory | GpsTrack, ground: F64, times: F64) -> tuple[float, F64]:
    """Metres along the whole truth, and (N,) along it at `times`; of a GPS track smoothed, lest noise add up."""
    if isinstance(truth, GpsTrack):
        truth = smooth(truth, COURSE_SECONDS)
        ground = truth.at(times)[:, :2]
    return float(way(truth.positions[:, :2])[-1]), way(ground)


def _poses(
    estimate: Trajectory, truth: Trajectory | GpsTrack, times: F64, index: I64, by: str
) -> tuple[F64, F64] | None:
    """(N, 3, 3) rotations of the estimate and of the truth; None where one has none."""
    if isinstance(truth, GpsTrack) or truth.rotations is None or estimate.rotations is None:
        return None
    return estimate.rotations[index], truth.rotations if by == "index" else truth.pose_at(times)[:, :3, :3]


def _rms(vectors: F64) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _pairs(distance: F64, starts: I64, length: float) -> tuple[I64, I64]:
    """Starts and ends of the motions that are the first to be longer than `length`."""
    ends = np.searchsorted(distance, distance[starts] + length, side="right")
    there = ends < len(distance)
    return starts[there], ends[there]


def _motions(chords: tuple[F64, F64], poses: tuple[F64, F64] | None, a: I64, b: I64) -> tuple[F64, F64 | None]:
    """(P,) errors in metres and in degrees of the motions from poses `a` to poses `b`.

    With rotations: of the motion in the first pose's axes. Without: of the length of the chord.
    """
    moved = [places[b] - places[a] for places in chords]
    if poses is None:
        return np.abs(np.linalg.norm(moved[0], axis=1) - np.linalg.norm(moved[1], axis=1)), None
    seen = [np.einsum("nji,nj->ni", turns[a], move) for turns, move in zip(poses, moved, strict=True)]
    turned = [turns[a].transpose(0, 2, 1) @ turns[b] for turns in poses]
    between = turned[1].transpose(0, 2, 1) @ turned[0]
    translation = seen[0] - seen[1]  # the error's length is the same in whichever axes
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    skew = between - between.transpose(0, 2, 1)
    sine = np.sqrt((skew**2).sum(axis=(1, 2)) / 8)  # arccos alone has no digits near zero
    return np.linalg.norm(translation, axis=1), np.degrees(np.arctan2(sine, cosine))


def _relative(chords: tuple[F64, F64], poses: tuple[F64, F64] | None, distance: F64, a: I64, b: I64) -> Relative | None:
    if not len(a):
        return None
    metres, degrees = _motions(chords, poses, a, b)
    travelled = float((distance[b] - distance[a]).sum())
    rotation = None if degrees is None or travelled == 0 else float(degrees.sum() / travelled)
    return Relative(float(np.sqrt((metres**2).mean())), rotation)


def _kitti(chords: tuple[F64, F64], poses: tuple[F64, F64] | None, distance: F64) -> Relative | None:
    """As KITTI's odometry benchmark has it: the mean over all lengths and starts."""
    starts = np.arange(0, len(distance), KITTI_STEP)
    shares: list[Any] = []
    turns: list[Any] = []
    for length in KITTI_LENGTHS:
        metres, degrees = _motions(chords, poses, *_pairs(distance, starts, length))
        shares.append(100 * metres / length)
        turns.append([] if degrees is None else degrees / length)
    share, turn = _mean(shares), _mean(turns)
    return None if share is None else Relative(share, turn)


def _mean(parts: Sequence[Any]) -> float | None:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else None
