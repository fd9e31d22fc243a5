"""Fuse: where a scanner was at each of its sweeps, by all that tells: its sweeps, a trajectory, GPS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.camera.poses import interpolate
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.parameters import Shift
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Frame, GpsTrack, Trajectory
from scan2sim.pipeline.importers import sweeps as io
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.slam.lidar_odometry import Matched
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.fusion import BELIEVED, Fixes, Fused, Steps, camera_steps, fuse, lidar_steps
from scan2sim.slam.trajectory.gps import smooth
from scan2sim.slam.trajectory.scale import MEMORY, SLOW

SMOOTHED = 2.0
"""Seconds of a track that was smoothed whose scatter is the same."""
SCATTER = 0.1
"""Of a receiver's slow error, what its fixes scatter at least: a short track doesn't tell."""
SHARPEST = 0.01
"""Metres by which any receiver is off."""
GAPS = 3.0
"""Times what is usual between two poses: over more, there is none in between."""


class FuseParams(Params):
    """How the sensors belong together.

    Attributes:
        scanner_poses, time_offset, crs: as of `pipeline.importers.sweeps.Placing`.
        gps_offset: seconds to add to GPS's times: to the clock of the trajectory, or of the sweeps.
    """

    scanner_poses: bool = Field(False, description="Poses are the scanner's all the same.")
    time_offset: Shift = Field(0.0, description="Seconds to add to times of sweeps and photos.")
    gps_offset: Shift = Field(0.0, description="Seconds to add to GPS's times.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')


def fuse_path(inputs: Inputs, params: FuseParams, out: Path, report: Report) -> Done:
    """The path of `sweeps` by what there is of `matched`, `poses` (with `extrinsics`) and `gps`.

    Its times are the sweeps' own (`time_offset` counts where the others are looked up).

    Raises:
        InputError: a file is damaged, or they are of different times.
        DataError: nothing tells where any sweep was taken.
    """
    files = io.files_of(inputs["sweeps"])
    given = io.read_poses(inputs["poses"], params.crs) if "poses" in inputs else None
    matched = Matched.load(inputs["matched"]) if "matched" in inputs else None
    seconds = _seconds(inputs, files, None if given is None else given[0], matched)
    times = seconds + params.time_offset
    frame, camera, first, T_camera_scanner = Frame(), None, None, np.eye(4)
    if given is not None:
        path, frame = given
        if "extrinsics" in inputs and not params.scanner_poses:
            T_camera_scanner = io.read_extrinsics(inputs["extrinsics"])
        camera = _camera(path, times, inputs["poses"])
        first = interpolate(path.poses, path.times, times[:1])[0] @ T_camera_scanner
    fixes = None
    if "gps" in inputs:
        frame, fixes = _gps(inputs["gps"], params, frame, times)
    elif given is not None and frame.crs != crs_io.LOCAL:
        fixes = _georeference(given[0], times)
    report(0.1, "solving")
    lidar = None if matched is None else lidar_steps(matched)
    fused = fuse(times, lidar=lidar, camera=camera, T_camera_scanner=T_camera_scanner, fixes=fixes, first=first)
    path = fused.trajectory
    assert path.unsure is not None
    if path.unsure.all():
        raise DataError(
            inputs["sweeps"], "show too little of one another to tell where they were taken",
            "See that they follow each other by name, or give a trajectory",
        )  # fmt: skip
    warnings: list[str] = []
    told = _told(fused, lidar, camera, "gps" in inputs, warnings.append)
    output.write(out / "path", replace(path, times=seconds), frame)
    return Done(
        {"path": out / "path", "trajectory": out / "path" / "trajectory.csv"},
        {"told": told, "unsure_share": round(float(path.unsure.mean()), 4)},
        warnings,
    )


def _seconds(inputs: Inputs, files: list[Path], path: Trajectory | None, matched: Matched | None) -> F64:
    """(N,) seconds of each sweep, in the sweeps' own clock.

    Raises:
        InputError: something asks for them, and nothing tells.
    """
    told = io.told_times(files, inputs.get("times"))
    if told is None and path is not None:
        told = io.moments(files, None, path, inputs["sweeps"])
    if told is None and "gps" in inputs:
        remedy = "Give their times in a file, seconds, one a line"
        raise InputError(inputs["sweeps"], "its sweeps have no times, and GPS is known by time", remedy)
    if told is None:
        assert matched is not None
        return matched.times
    if len(told) < 2 or (np.diff(told) <= 0).any():
        raise InputError(inputs["sweeps"], "its sweeps' times don't ascend", "Mend the times; each once, two at least")
    return told


def _camera(path: Trajectory, times: F64, file: Path) -> Steps:
    """The steps of a trajectory.

    Raises:
        InputError: it is of another time.
    """
    usual = float(np.median(np.diff(path.times))) if len(path) > 1 else 0.0
    steps = camera_steps(path, times, max(io.GAP, GAPS * usual))
    if times[-1] < path.times[0] or times[0] > path.times[-1]:
        raise _apart(file, path.times, times, "--time-offset")
    return steps


def _gps(file: Path, params: FuseParams, frame: Frame, times: F64) -> tuple[Frame, Fixes]:
    """GPS's fixes at times (N,), and the frame they are in: the trajectory's if that is georeferenced, or their own.

    Raises:
        InputError: the track can't be read, or is of another time.
    """
    raw = gps_io.read(file).shifted(params.gps_offset)
    track = smooth(raw)
    there = track.at(times)
    if not np.isfinite(there).any():
        raise _apart(file, track.times, times, "--gps-offset")
    crs = track.frame.crs if params.crs == crs_io.LOCAL else params.crs
    places = _into(track, there, crs)
    if frame.crs == crs_io.LOCAL:
        x, y, z = np.floor(places[np.isfinite(places[:, 0])][0]).tolist()
        frame = Frame(crs, (x, y, z))
    rate = len(times) / max(float(times[-1] - times[0]), 1e-9)
    slow = SLOW if track.sigma is None else max(float(np.median(track.sigma)), SHARPEST)
    scatter = max(track.scatter, SCATTER * slow) * np.sqrt(max(1.0, rate * SMOOTHED))
    return frame, Fixes(frame.to_local(places), float(scatter), slow, MEMORY)


def _into(track: GpsTrack, there: F64, crs: str) -> F64:
    """(N, 3) places of a track in another CRS; heights stay as they are."""
    places = track.frame.to_crs(there)
    if crs_io.LOCAL in (crs, track.frame.crs) or crs_io.same(crs, track.frame.crs):
        return places
    from pyproj import CRS, Transformer

    own, wanted = (CRS.from_user_input(one).to_2d() for one in (track.frame.crs, crs))
    x, y = Transformer.from_crs(own, wanted, always_xy=True).transform(places[:, 0], places[:, 1])
    return np.column_stack([x, y, places[:, 2]])


def _georeference(path: Trajectory, times: F64) -> Fixes:
    """What a georeferenced trajectory says of places: it was tied by GPS, which errs slowly."""
    known = GpsTrack(path.times, path.positions)
    places = known.at(times)
    if path.unsure is not None:
        places[np.interp(times, path.times, path.unsure) > 0] = np.nan
    sigma = SLOW
    if path.covariance is not None:
        sigma = float(np.median(np.sqrt(path.covariance[:, 0, 0] + path.covariance[:, 1, 1]) / np.sqrt(2)))
    rate = len(times) / max(float(times[-1] - times[0]), 1e-9)
    sigma = max(sigma, SHARPEST)
    return Fixes(places, SCATTER * sigma * float(np.sqrt(max(1.0, rate * SMOOTHED))), sigma, MEMORY)


def _apart(file: Path, own: F64, times: F64, option: str) -> InputError:
    spans = f"spans {own[0]:.2f} to {own[-1]:.2f} s, the sweeps {times[0]:.2f} to {times[-1]:.2f} s"
    return InputError(file, spans, f"Give times of one clock, or {option}")


def _told(fused: Fused, lidar: Steps | None, camera: Steps | None, gps: bool, warn: Callable[[str], None]) -> str:
    """What was used, in words."""
    parts = []
    for name, what, steps in (("lidar", "sweeps", lidar), ("camera", "trajectory", camera)):
        if steps is not None:
            share = float((steps.sure & (fused.trust[name] > BELIEVED)).mean())
            parts.append(f"{what} ({100 * share:.0f} % of the steps)")
    if lidar is not None and camera is not None:
        both = lidar.sure & camera.sure
        against = both & (np.minimum(fused.trust["lidar"], fused.trust["camera"]) < BELIEVED)
        if both.any() and against.sum() > 0.5 * both.sum():
            part = f"{100 * against.sum() / both.sum():.0f} %"
            warn(f"sweeps and trajectory contradict each other at {part} of the steps: are extrinsics, times right?")
    if gps:
        parts.append(f"GPS ({int((fused.trust['gps'] > BELIEVED).sum())} of {len(fused.trust['gps'])} places)")
    return "placed by " + ", ".join(parts)


FUSE = Step("fuse", 2, fuse_path, FuseParams)
