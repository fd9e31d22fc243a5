"""Track: a video, frame by frame, to a trajectory; what was done is kept, so that an interrupted run goes on."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import DataError, InputError
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import U8, Camera, Frame, GpsTrack, Trajectory
from scan2sim.slam.features import Found
from scan2sim.slam.finish import Placing, finish
from scan2sim.slam.localmap import Keyframe, Landmarks
from scan2sim.slam.odometry import Odometry, Placed
from scan2sim.slam.relocalise import Remembered, Seen
from scan2sim.slam.state import WrongState, load, save
from scan2sim.slam.trackers import Tracks
from scan2sim.slam.trackers.descriptors import SeenInChart
from scan2sim.slam.video import Video

VERSION = 1
"""Raised whenever the same video comes to another trajectory with the same options: what older code left, a state of an
interrupted run or a trajectory that is kept, is begun anew then."""
KEEP_EVERY = 60.0
"""Seconds between states kept."""
VALUES = (Found, Keyframe, Landmarks, Placed, Remembered, Seen, SeenInChart, Tracks)
"""What states consist of."""


@dataclass(frozen=True)
class Tracked:
    """What came out.

    Attributes:
        trajectory: camera to local coordinates of `frame`.
        frame: where that is.
        names: of the frames.
        odometry: with all that it knows.
        placing: from its world to the trajectory's.
        alone: what odometry alone said, where loops or an adjustment came after it.
        facts: figures.
        warnings: sentences a user should read.
    """

    trajectory: Trajectory
    frame: Frame
    names: list[str]
    odometry: Odometry
    placing: Placing
    alone: Trajectory | None
    facts: dict[str, Any]
    warnings: list[str]


class _Run:
    """A run as far as it has come."""

    STATE = ("names", "warnings", "seconds")
    PARTS = ("odometry",)

    def __init__(self, start: Callable[[Callable[[str], None]], Odometry]) -> None:
        self.names: list[str] = []
        self.warnings: list[str] = []
        self.seconds = 0.0
        self.odometry = start(self.warn)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def track(
    video: Video,
    start: Callable[[Callable[[str], None]], Odometry],
    *,
    gps: GpsTrack | None = None,
    georeference: bool = True,
    every: int = 1,
    until: float | None = None,
    state: Path | None = None,
    watch: Callable[[Odometry, U8], None] | None = None,
    after: Sequence[Callable[[Odometry], dict[str, float]]] = (),
    report: Report = silent,
) -> Tracked:
    """Run odometry over a video.

    Args:
        video: frames.
        start: makes the odometry, given where to send warnings.
        gps: the track, in the frames' times.
        georeference: put the trajectory where GPS says; otherwise GPS ties its scale alone.
        every: take every so manieth frame.
        until: stop after so many seconds of the video.
        state: file in which the state is kept every minute, and from which an interrupted run goes on.
        after: what moves the keyframes once all are there (loops, adjustment), and its figures.
        watch: is shown odometry and frame after each.
        report: progress.

    Raises:
        DataError: fewer than two frames.
    """
    kept = _begin(start, state)
    began, saved = clock.perf_counter() - kept.seconds, clock.perf_counter()
    last = kept.odometry.placed[-1].time if kept.odometry.placed else -np.inf
    for frame in video.frames(every=every, warn=kept.warn):
        if frame.time <= last:
            continue
        if until is not None and frame.time > until:
            break
        kept.odometry.add(frame.time, frame.grey)
        kept.names.append(frame.name)
        if watch is not None:
            watch(kept.odometry, frame.grey)
        if video.count:
            report(min(1.0, frame.number / video.count), f"{len(kept.names)} frames")
        if state is not None and clock.perf_counter() - saved > KEEP_EVERY:
            kept.seconds, saved = clock.perf_counter() - began, clock.perf_counter()
            save(state, kept, VALUES)
    if len(kept.names) < 2:
        raise DataError(video.path, f"has {len(kept.names)} frames", "Give a longer video")
    kept.seconds = clock.perf_counter() - began
    if gps is None:
        kept.warnings.append("there is no GPS: lengths are in multiples of the first two keyframes' distance")
    trajectory, placing = finish(kept.odometry, gps, georeference=georeference)
    alone, facts = trajectory if after else None, _facts(kept, trajectory)
    for work in after:
        facts |= work(kept.odometry)
    if after:
        trajectory, placing = finish(kept.odometry, gps, georeference=georeference)
    return Tracked(
        trajectory, placing.frame, kept.names, kept.odometry, placing, alone, facts, list(dict.fromkeys(kept.warnings))
    )


def _facts(kept: _Run, trajectory: Trajectory) -> dict[str, Any]:
    assert trajectory.unsure is not None
    way = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    shared = dict(zip(kept.odometry.map.names, np.round(kept.odometry.map.shared, 5).tolist(), strict=True))
    return {
        "frames": len(trajectory),
        "keyframes": len(kept.odometry.map.keyframes),
        "length_m": round(float(way.sum()), 2),
        "unsure_share": round(float(trajectory.unsure.mean()), 4),
        "maps": kept.odometry.map.part + 1,
        "seconds": round(kept.seconds, 2),
        "fps": round(len(trajectory) / max(kept.seconds, 1e-9), 2),
        **shared,
    }


def _begin(start: Callable[[Callable[[str], None]], Odometry], state: Path | None) -> _Run:
    """A run at its beginning, or where an earlier one was interrupted."""
    if state is None or not state.is_file():
        return _Run(start)
    try:
        run = _Run(start)
        load(state, run, VALUES)
    except WrongState:
        run = _Run(start)
        run.warn(f"what an interrupted run left in {state.name} is damaged: begun anew")
    return run


def camera_of(video: Video, model: str, focal: float | None, centre: tuple[float, float] | None) -> Camera:
    """The camera of a video: equirectangular if it is twice as wide as high and nothing else is said.

    Raises:
        InputError: a perspective video without a focal length, a 360 video of another shape.
    """
    w, h = video.width, video.height
    if model == "auto":
        model = "equirectangular" if w == 2 * h and focal is None else "pinhole"
    if model == "equirectangular":
        if abs(w - 2 * h) > 2:
            raise InputError(video.path, f"is {w}x{h}, not twice as wide as high", "Name its camera: --camera pinhole")
        return Camera("equirectangular", w, h)
    if focal is None:
        raise InputError(video.path, "needs a camera", "Give --focal (pixels), or a tile whose camera it is")
    cx, cy = centre or ((w - 1) / 2, (h - 1) / 2)
    return Camera("pinhole", w, h, focal, focal, cx, cy)
