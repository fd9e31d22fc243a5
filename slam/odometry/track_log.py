"""Track log: corners tracked through a video once, in pixels, to run odometry over them with several lenses.

Tracking in pixels doesn't depend on the lens, only the bearings of the pixels do. So another lens can be tested
without reading and tracking the images again, which takes most of the time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, I64, U8, Camera
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trackers import Tracks, named
from scan2sim.slam.video import Video
from scan2sim.slam.virtual_cameras import VirtualViews

CORNERS = 350
"""Number of corners tracked at a time: half of odometry's default, so that a lens is tested faster."""


@dataclass
class TrackLog:
    """Tracked corners of a video.

    Attributes:
        size: width and height of the frames, pixels.
        times: seconds of each frame.
        ids: per frame (N,) ids of the corners.
        uv: per frame (N, 2) pixels of the corners.
    """

    size: tuple[int, int]
    times: list[float] = field(default_factory=list)
    ids: list[I64] = field(default_factory=list)
    uv: list[F64] = field(default_factory=list)

    def part(self, first: int, end: int) -> TrackLog:
        """Frames from `first` up to, but not including, `end`."""
        frames = slice(first, end)
        return TrackLog(self.size, self.times[frames], self.ids[frames], self.uv[frames])


def record_tracks(
    video: Video,
    mask: U8 | None,
    *,
    every: int = 1,
    until: float | None = None,
    report: Report = silent,
) -> TrackLog:
    """Track corners through every Nth frame of a video.

    Args:
        video: frames.
        mask: (H, W) ego-vehicle mask, 0 where the car itself is visible.
        every: N.
        until: seconds of the video after which to stop; None: at its end.
        report: receives progress.
    """
    camera = centred_pinhole(video.width, video.height, float(video.width))
    tracker = named("corners", VirtualViews(camera), mask, CORNERS)
    out = TrackLog((video.width, video.height))
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


def centred_pinhole(width: int, height: int, focal: float) -> Camera:
    """Pinhole camera of a focal length in pixels, its principal point at the image centre."""
    return Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


class Replay:
    """A `slam.trackers.Tracker` that replays a track log, as seen through a given camera."""

    def __init__(self, log: TrackLog, camera: Camera) -> None:
        self.tracks = Tracks()
        self.images: list[U8] = [np.zeros((64, 64), np.uint8)]
        self._log, self._camera, self._frame = log, camera, -1
        self._dropped = np.zeros(0, np.int64)

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Advance to the next frame of the log; returns the share of tracks that continue."""
        self._frame += 1
        now, before = self._now(), self.tracks
        self.tracks = now.keep(np.isin(now.ids, before.ids))
        return len(self.tracks) / max(len(before), 1)

    def drop(self, ids: I64) -> None:
        """Stop tracking these ids."""
        self._dropped = np.union1d(self._dropped, ids)
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        """Add all tracks of the frame that weren't dropped; returns how many were added."""
        before, now = len(self.tracks), self._now()
        self.tracks = now.keep(~np.isin(now.ids, self._dropped))
        return len(self.tracks) - before

    def _now(self) -> Tracks:
        ids, uv = self._log.ids[self._frame], self._log.uv[self._frame]
        bearing = unproject(self._camera, uv)
        seen = np.isfinite(bearing[:, 0])
        return Tracks(ids[seen], bearing[seen])


def replay(log: TrackLog, camera: Camera, params: OdometryParams) -> Odometry:
    """Run odometry over a track log, as if it had been recorded by `camera`."""
    odometry = Odometry(camera, params, tracker=Replay(log, camera), keep=True)
    no_image = np.zeros((1, 1), np.uint8)
    for time in log.times:
        odometry.add(time, no_image)
    return odometry
