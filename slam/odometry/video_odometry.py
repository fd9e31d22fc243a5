"""Track: a video, frame by frame, to a trajectory; what was done is kept, so that an interrupted run goes on."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import U8
from scan2sim.slam.features import Found
from scan2sim.slam.mapping.local_map import Keyframe, Landmarks
from scan2sim.slam.odometry.checkpoint import WrongState, load, save
from scan2sim.slam.odometry.odometry import Odometry, Placed
from scan2sim.slam.odometry.patch_alignment import Patches
from scan2sim.slam.odometry.relocalization import Remembered, Seen
from scan2sim.slam.trackers import Tracks
from scan2sim.slam.trackers.descriptors import SeenInFacet
from scan2sim.slam.video import Video

VERSION = 11
"""Raised whenever the same video comes to another trajectory with the same options: what older code left, a state of an
interrupted run or a trajectory that is kept, is begun anew then."""
KEEP_EVERY = 60.0
"""Seconds between states kept."""
VALUES = (Found, Keyframe, Landmarks, Patches, Placed, Remembered, Seen, SeenInFacet, Tracks)
"""What states consist of."""


class Run:
    """A run over a video, as far as it has come.

    Attributes:
        names: of the frames that were taken.
        warnings: sentences a user should read.
        seconds: that it took.
        odometry: what it has found.
    """

    STATE = ("names", "warnings", "seconds")
    PARTS = ("odometry",)

    def __init__(self, start: Callable[[Callable[[str], None]], Odometry]) -> None:
        self.names: list[str] = []
        self.warnings: list[str] = []
        self.seconds = 0.0
        self.odometry = start(self.warnings.append)

    def facts(self) -> dict[str, Any]:
        """Figures of it."""
        found = self.odometry.map
        return {
            "frames": len(self.names),
            "keyframes": len(found.keyframes),
            "maps": found.part + 1,
            "seconds": round(self.seconds, 2),
            "fps": round(len(self.names) / max(self.seconds, 1e-9), 2),
            **dict(zip(found.names, np.round(found.shared, 5).tolist(), strict=True)),
        }


def track(
    video: Video,
    start: Callable[[Callable[[str], None]], Odometry],
    *,
    every: int = 1,
    until: float | None = None,
    state: Path | None = None,
    watch: Callable[[Odometry, U8], None] | None = None,
    report: Report = silent,
) -> Run:
    """Run odometry over a video.

    Args:
        video: frames.
        start: makes the odometry, given where to send warnings.
        every: take every so manieth frame.
        until: stop after so many seconds of the video.
        state: file in which the state is kept every minute, and from which an interrupted run goes on.
        watch: is shown odometry and frame after each.
        report: progress.

    Raises:
        DataError: fewer than two frames.
    """
    kept = _begin(start, state)
    began, saved = clock.perf_counter() - kept.seconds, clock.perf_counter()
    last = kept.odometry.placed[-1].time if kept.odometry.placed else -np.inf
    for frame in video.frames(every=every, warn=kept.warnings.append):
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
    return kept


def _begin(start: Callable[[Callable[[str], None]], Odometry], state: Path | None) -> Run:
    """A run at its beginning, or where an earlier one was interrupted."""
    if state is None or not state.is_file():
        return Run(start)
    try:
        run = Run(start)
        load(state, run, VALUES)
    except WrongState:
        run = Run(start)
        run.warnings.append(f"what an interrupted run left in {state.name} is damaged: begun anew")
    return run
