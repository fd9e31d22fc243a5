"""Recording: corners followed through a video once, in pixels; odometry is run over them with one lens after another.

What a camera sees is followed in its pixels, whatever its lens: only what pixels mean differs. So a lens can be tried
without looking at the pictures again, which takes most of the time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, I64, U8, Camera
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import Tracks, named
from scan2sim.slam.video import Video

COUNT = 350
"""Corners that are followed at a time: half of odometry's, a lens is tried the faster."""


@dataclass
class Recording:
    """What was followed: `times` of the frames, of each `ids` (N,) and pixels `uv` (N, 2); `size`: width, height."""

    size: tuple[int, int]
    times: list[float] = field(default_factory=list)
    ids: list[I64] = field(default_factory=list)
    uv: list[F64] = field(default_factory=list)

    def part(self, first: int, last: int) -> Recording:
        """Frames `first` to `last`, that one left out."""
        some = slice(first, last)
        return Recording(self.size, self.times[some], self.ids[some], self.uv[some])


def record(
    video: Video,
    mask: U8 | None,
    *,
    every: int = 1,
    until: float | None = None,
    report: Report = silent,
) -> Recording:
    """Follow corners through every so manieth frame, up to `until` (seconds); `mask` (H, W): 0 where the car is."""
    camera = plain(video.width, video.height, float(video.width))
    tracker = named("corners", Facets(camera), mask, COUNT)
    out = Recording((video.width, video.height))
    for frame in video.frames(every=every):
        if until is not None and frame.time > until:
            break
        tracker.track(frame.grey)
        tracker.refill()
        out.times.append(frame.time)
        out.ids.append(tracker.tracks.ids)
        out.uv.append(project_exactly(camera, tracker.tracks.bearing)[0])
        if video.count:
            report(min(1.0, frame.number / video.count), f"{len(out.times)} frames")
    return out


def plain(width: int, height: int, focal: float) -> Camera:
    """A pinhole camera whose centre is the picture's."""
    return Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


class Replay:
    """A `slam.trackers.Tracker` of what was recorded, as a camera sees it."""

    def __init__(self, recording: Recording, camera: Camera) -> None:
        self.tracks = Tracks()
        self.pictures: list[U8] = [np.zeros((64, 64), np.uint8)]
        self._recording, self._camera, self._frame = recording, camera, -1
        self._dropped = np.zeros(0, np.int64)

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """The next frame's."""
        self._frame += 1
        now, before = self._now(), self.tracks
        self.tracks = now.keep(np.isin(now.ids, before.ids))
        return len(self.tracks) / max(len(before), 1)

    def drop(self, ids: I64) -> None:
        """Don't follow these any more."""
        self._dropped = np.union1d(self._dropped, ids)
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        """Take all that the frame has."""
        before, now = len(self.tracks), self._now()
        self.tracks = now.keep(~np.isin(now.ids, self._dropped))
        return len(self.tracks) - before

    def _now(self) -> Tracks:
        ids, uv = self._recording.ids[self._frame], self._recording.uv[self._frame]
        bearing = unproject(self._camera, uv)
        seen = np.isfinite(bearing[:, 0])
        return Tracks(ids[seen], bearing[seen])


def replay(recording: Recording, camera: Camera, params: OdometryParams) -> Odometry:
    """Odometry over what was recorded, as if `camera` had seen it."""
    odometry = Odometry(camera, params, tracker=Replay(recording, camera), keep=True)
    nothing = np.zeros((1, 1), np.uint8)
    for time in recording.times:
        odometry.add(time, nothing)
    return odometry
