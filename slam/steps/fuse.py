"""Step `fuse`: the scanner's pose at each sweep, by sensor fusion of matched sweeps, a trajectory and GPS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.parameters import Shift
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Frame, GpsTrack, Trajectory
from scan2sim.pipeline.importers.scanner_path import MAX_POSE_GAP_S
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import sweep_files
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.calibration import read_extrinsics
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.slam.lidar_odometry import MatchedSweeps
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.fusion import (
    MODEL,
    Fused,
    GpsFixes,
    RelativeMotions,
    camera_motions,
    fuse,
    lidar_motions,
)
from scan2sim.slam.trajectory.gps import smooth
from scan2sim.slam.trajectory.scale import GPS_BIAS_M, GPS_BIAS_S

SMOOTHING_S = 2.0
"""Correlation time of a smoothed track's scatter."""
SCATTER_SHARE_MIN = 0.1
"""Least scatter of fixes as a share of the slow error; a short track underestimates it."""
GPS_SIGMA_MIN_M = 0.01
"""Least error of any receiver."""
POSE_GAP_FACTOR = 3.0
"""Multiple of the median interval between poses above which there is a gap."""


class FuseParams(Params):
    """Settings that relate the sensors.

    Attributes:
        scanner_poses: treat the poses as scanner poses even if extrinsics are given.
        invert_extrinsics: the extrinsics are T_scanner_camera.
        time_offset: seconds to add to the times of sweeps and photos.
        gps_offset: seconds to add to GPS times, to convert them to the clock of the trajectory, or of the sweeps.
        crs: projected CRS of the poses, such as "EPSG:32633"; "local" if they aren't georeferenced.
        quaternions: order of the poses' quaternions.
    """

    scanner_poses: bool = Field(False, description="Treat the poses as scanner poses even if extrinsics are given.")
    invert_extrinsics: bool = Field(
        False, description="The extrinsics are T_scanner_camera: from camera axes to scanner axes."
    )
    time_offset: Shift = Field(0.0, description="Seconds to add to the times of sweeps and photos.")
    gps_offset: Shift = Field(0.0, description="Seconds to add to GPS times.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')
    quaternions: trajectory_io.QuaternionOrder = Field("xyzw", description=trajectory_io.QUATERNIONS_HELP)


def fuse_path(inputs: Inputs, params: FuseParams, out: Path, report: Report) -> Done:
    """Path of `sweeps` from any of `matched` sweeps, `poses` (with optional `extrinsics`), and `gps`.

    The result has the sweeps' own times; `time_offset` only converts them to the clock of the other inputs.

    Raises:
        InputError: a file is damaged, or the times of the inputs don't overlap.
        DataError: the pose of no sweep can be determined.
    """
    files = sweep_files.list_files(inputs["sweeps"])
    given = trajectory_io.read_local(inputs["poses"], params.crs, params.quaternions) if "poses" in inputs else None
    matched = MatchedSweeps.load(inputs["matched"]) if "matched" in inputs else None
    seconds = _seconds(inputs, files, None if given is None else given[0], matched)
    times = seconds + params.time_offset
    frame, camera, first, T_camera_scanner = Frame(), None, None, np.eye(4)
    if given is not None:
        path, frame = given
        if "extrinsics" in inputs and not params.scanner_poses:
            T_camera_scanner = read_extrinsics(inputs["extrinsics"])
            if params.invert_extrinsics:
                T_camera_scanner = np.asarray(np.linalg.inv(T_camera_scanner), np.float64)
        camera = _camera(path, times, inputs["poses"])
        first = interpolate(path.poses, path.times, times[:1])[0] @ T_camera_scanner
    fixes = None
    if "gps" in inputs:
        frame, fixes = _gps(inputs["gps"], params, frame, times)
    elif given is not None and frame.crs != crs_io.LOCAL:
        fixes = _georeference(given[0], times)
    report(0.1, "solving")
    lidar = None if matched is None else lidar_motions(matched)
    fused = fuse(times, lidar=lidar, camera=camera, T_camera_scanner=T_camera_scanner, fixes=fixes, first=first)
    path = fused.trajectory
    assert path.unsure is not None
    if path.unsure.all():
        raise DataError(
            inputs["sweeps"], "overlap too little with each other to determine the scanner's path",
            "Check that the order of their names is the order of time, or give a trajectory",
        )  # fmt: skip
    warnings: list[str] = []
    summary = _summary(fused, lidar, camera, "gps" in inputs, warnings.append)
    output.write(out / "path", replace(path, times=seconds), frame)
    return Done(
        {"path": out / "path", "trajectory": out / "path" / "trajectory.csv"},
        {"summary": summary, "unsure_share": round(float(path.unsure.mean()), 4)},
        warnings,
    )


def _seconds(inputs: Inputs, files: list[Path], path: Trajectory | None, matched: MatchedSweeps | None) -> F64:
    """(N,) seconds of each sweep, in the sweeps' own clock.

    Raises:
        InputError: times are needed but unknown, or they don't increase.
    """
    seconds = sweep_files.file_times(files, inputs.get("times"))
    if seconds is None and path is not None:
        seconds = sweep_files.timestamps(files, None, path, inputs["sweeps"])
    if seconds is None and "gps" in inputs:
        remedy = "Give a file with their times: seconds, one per line"
        raise InputError(inputs["sweeps"], "its sweeps have no times, which GPS needs", remedy)
    if seconds is None:
        assert matched is not None
        return matched.times
    if len(seconds) < 2 or (np.diff(seconds) <= 0).any():
        raise InputError(
            inputs["sweeps"],
            "its sweeps' times don't increase",
            "Fix the times: at least two, each later than the last",
        )
    return seconds


def _camera(path: Trajectory, times: F64, file: Path) -> RelativeMotions:
    """Relative motions of a trajectory.

    Raises:
        InputError: its times don't overlap with those of the sweeps.
    """
    interval = float(np.median(np.diff(path.times))) if len(path) > 1 else 0.0
    motions = camera_motions(path, times, max(MAX_POSE_GAP_S, POSE_GAP_FACTOR * interval))
    if times[-1] < path.times[0] or times[0] > path.times[-1]:
        raise _no_time_overlap(file, path.times, times, "--time-offset")
    return motions


def _gps(file: Path, params: FuseParams, frame: Frame, times: F64) -> tuple[Frame, GpsFixes]:
    """GPS positions at times (N,), and their frame: the trajectory's if it is georeferenced, else the track's.

    Raises:
        InputError: the track can't be read, or its times don't overlap with those of the sweeps.
    """
    raw = gps_io.read(file).shifted(params.gps_offset)
    track = smooth(raw)
    local = track.at(times)
    if not np.isfinite(local).any():
        raise _no_time_overlap(file, track.times, times, "--gps-offset")
    crs = track.frame.crs if params.crs == crs_io.LOCAL else params.crs
    positions = _in_crs(track, local, crs)
    if frame.crs == crs_io.LOCAL:
        x, y, z = np.floor(positions[np.isfinite(positions[:, 0])][0]).tolist()
        frame = Frame(crs, (x, y, z))
    rate = len(times) / max(float(times[-1] - times[0]), 1e-9)
    bias = GPS_BIAS_M if track.sigma is None else max(float(np.median(track.sigma)), GPS_SIGMA_MIN_M)
    scatter = max(track.scatter, SCATTER_SHARE_MIN * bias) * np.sqrt(max(1.0, rate * SMOOTHING_S))
    return frame, GpsFixes(frame.to_local(positions), float(scatter), bias, GPS_BIAS_S)


def _in_crs(track: GpsTrack, local: F64, crs: str) -> F64:
    """(N, 3) local positions of a track, converted to a CRS; heights stay unchanged."""
    positions = track.frame.to_crs(local)
    if crs_io.LOCAL in (crs, track.frame.crs) or crs_io.same(crs, track.frame.crs):
        return positions
    from pyproj import CRS, Transformer

    own, target = (CRS.from_user_input(one).to_2d() for one in (track.frame.crs, crs))
    x, y = Transformer.from_crs(own, target, always_xy=True).transform(positions[:, 0], positions[:, 1])
    return np.column_stack([x, y, positions[:, 2]])


def _georeference(path: Trajectory, times: F64) -> GpsFixes:
    """Positions of a georeferenced trajectory as GPS fixes: it was aligned to GPS, and has its slow error."""
    known = GpsTrack(path.times, path.positions)
    positions = known.at(times)
    if path.unsure is not None:
        positions[np.interp(times, path.times, path.unsure) > 0] = np.nan
    sigma = GPS_BIAS_M
    if path.covariance is not None:
        sigma = float(np.median(np.sqrt(path.covariance[:, 0, 0] + path.covariance[:, 1, 1]) / np.sqrt(2)))
    rate = len(times) / max(float(times[-1] - times[0]), 1e-9)
    sigma = max(sigma, GPS_SIGMA_MIN_M)
    scatter = SCATTER_SHARE_MIN * sigma * float(np.sqrt(max(1.0, rate * SMOOTHING_S)))
    return GpsFixes(positions, scatter, sigma, GPS_BIAS_S)


def _no_time_overlap(file: Path, own: F64, times: F64, option: str) -> InputError:
    spans = f"spans {own[0]:.2f} to {own[-1]:.2f} s, the sweeps {times[0]:.2f} to {times[-1]:.2f} s"
    return InputError(file, spans, f"Give times of the same clock, or {option}")


def _summary(
    fused: Fused,
    lidar: RelativeMotions | None,
    camera: RelativeMotions | None,
    gps: bool,
    warn: Callable[[str], None],
) -> str:
    """Summary for the report: which sensors determined the path, and to what share."""
    parts = []
    for name, label, motions in (("lidar", "sweeps", lidar), ("camera", "trajectory", camera)):
        if motions is not None:
            share = float((motions.sure & (fused.trust[name] > MODEL.trust_min)).mean())
            parts.append(f"{label} ({100 * share:.0f} % of the motions)")
    if lidar is not None and camera is not None:
        both = lidar.sure & camera.sure
        contradicting = both & (np.minimum(fused.trust["lidar"], fused.trust["camera"]) < MODEL.trust_min)
        if both.any() and contradicting.sum() > 0.5 * both.sum():
            part = f"{100 * contradicting.sum() / both.sum():.0f} %"
            warn(f"sweeps and trajectory contradict each other in {part} of the motions: check extrinsics and times")
    if gps:
        parts.append(
            f"GPS ({int((fused.trust['gps'] > MODEL.trust_min).sum())} of {len(fused.trust['gps'])} positions)"
        )
    return "placed by " + ", ".join(parts)


FUSE = Step("fuse", 2, fuse_path, FuseParams)
