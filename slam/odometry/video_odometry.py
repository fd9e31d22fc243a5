"""Video odometry: runs odometry over the frames of a video, with checkpoints from which an interrupted run resumes."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.slam.features import FeatureSet
from scan2sim.slam.mapping.local_map import Keyframe, Landmarks
from scan2sim.slam.odometry.checkpoint import InvalidCheckpoint, load, save
from scan2sim.slam.odometry.odometry import Failure, Loss, Odometry, Placed
from scan2sim.slam.odometry.relocalization import FrameFeatures, KeyframeFeatures
from scan2sim.slam.odometry.track_log import TrackLog
from scan2sim.slam.optical_flow.patch_alignment import Patches
from scan2sim.slam.trackers import Tracks
from scan2sim.slam.trackers.descriptors import ViewFeatures
from scan2sim.slam.video import Video

VERSION = 14
"""Version of the step's result. Increased whenever the same video and options give another trajectory: checkpoints and
cached trajectories of an older version are then discarded and computed again."""
CHECKPOINT_INTERVAL_S = 60.0
VALUES = (
    FeatureSet, Keyframe, Landmarks, Patches, Placed, Loss, Failure, KeyframeFeatures, FrameFeatures, ViewFeatures,
    Tracks,
)  # fmt: skip
"""Types that occur in a checkpoint."""


class Run:
    """State of a run over a video.

    Attributes:
        names: names of the frames processed so far.
        warnings: warnings for the user.
        seconds: computing time so far.
        odometry: odometry after the last frame.
    """

    STATE = ("names", "warnings", "seconds")
    PARTS = ("odometry",)

    def __init__(self, start: Callable[[Callable[[str], None]], Odometry]) -> None:
        self.names: list[str] = []
        self.warnings: list[str] = []
        self.seconds = 0.0
        self.odometry = start(self.warnings.append)

    def metrics(self) -> dict[str, Any]:
        """Metrics for the report."""
        local_map = self.odometry.map
        return {
            "frames": len(self.names),
            "keyframes": len(local_map.keyframes),
            "maps": local_map.part + 1,
            "seconds": round(self.seconds, 2),
            "fps": round(len(self.names) / max(self.seconds, 1e-9), 2),
            **dict(zip(local_map.names, np.round(local_map.shared, 5).tolist(), strict=True)),
            "losses": [self._loss(loss) for loss in self.odometry.losses],
        }

    def _loss(self, loss: Loss) -> dict[str, Any]:
        """A loss of tracking for `slam.json`."""
        what, measured, needed, allowed = loss.failure
        limits = {"needed": needed, "allowed": allowed}
        return {
            "frame": self.names[loss.frame], "time": round(loss.time, 3), "failed": what,
            "measured": round(measured, 3), **{key: round(v, 3) for key, v in limits.items() if v is not None},
            "new_maps": loss.new_maps, "resumed": None if loss.resumed is None else round(loss.resumed, 3),
        }  # fmt: skip


def track(
    video: Video,
    start: Callable[[Callable[[str], None]], Odometry],
    *,
    every: int = 1,
    until: float | None = None,
    log: TrackLog | None = None,
    state: Path | None = None,
    report: Report = silent,
) -> Run:
    """Run odometry over a video.

    Args:
        video: frames.
        start: creates the odometry; its argument receives warnings.
        every: process every Nth frame.
        until: seconds of the video after which to stop.
        log: frames whose features were tracked before, and are replayed, without reading images.
        state: checkpoint file, written every minute; if it exists, the run resumes from it.
        report: receives progress.

    Raises:
        DataError: fewer than two frames.
    """
    run = _new_or_resumed(start, state)
    began, saved = clock.perf_counter() - run.seconds, clock.perf_counter()
    last = run.odometry.placed[-1].time if run.odometry.placed else -np.inf
    if log is not None:
        run.warnings.extend(log.warnings)
    read = video.frames(every=every, warn=run.warnings.append)
    for frame in read if log is None else log.frames():
        if frame.time <= last:
            continue
        if until is not None and frame.time > until:
            break
        run.odometry.add(frame.time, frame.grey)
        run.names.append(frame.name)
        if video.count:
            report(min(1.0, frame.number / video.count), f"{len(run.names)} frames")
        if state is not None and clock.perf_counter() - saved > CHECKPOINT_INTERVAL_S:
            run.seconds, saved = clock.perf_counter() - began, clock.perf_counter()
            save(state, run, VALUES)
    if len(run.names) < 2:
        raise DataError(video.path, f"has only {len(run.names)} readable frames, 2 are needed", "Give a longer video")
    run.seconds = clock.perf_counter() - began
    return run


def _new_or_resumed(start: Callable[[Callable[[str], None]], Odometry], state: Path | None) -> Run:
    """A new run, or an interrupted one restored from its checkpoint."""
    if state is None or not state.is_file():
        return Run(start)
    try:
        run = Run(start)
        load(state, run, VALUES)
    except InvalidCheckpoint:
        run = Run(start)
        run.warnings.append(
            f"the checkpoint {state.name} of an interrupted run is damaged: starting from the beginning"
        )
    return run
