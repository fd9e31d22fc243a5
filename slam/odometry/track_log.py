"""Track log: features tracked through a video once, in pixels, to run odometry over them with several lenses.

Tracking in pixels doesn't depend on the lens, only the bearings of the pixels do. So another lens can be tested, or the
drive tracked again with a refined one, without reading and tracking the images again, which takes most of the time.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, I64, U8, Camera
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trackers import Tracker, Tracks, named
from scan2sim.slam.video import Frame, Video
from scan2sim.slam.virtual_cameras import VirtualViews

CORNERS = 350
"""Number of corners tracked at a time: half of odometry's default, so that a lens is tested faster."""
RECORD = np.dtype([("id", "<i4"), ("uv", "<f4", 2)])
"""An observation in a log file: id of the feature, and its pixel, to 1e-4 pixels."""
NO_IMAGE: U8 = np.zeros((1, 1), np.uint8)


@dataclass
class TrackLog:
    """Tracked features of a video.

    Attributes:
        size: width and height of the frames, pixels.
        times: seconds of each frame.
        ids: per frame (N,) ids of the features, ascending.
        uv: per frame (N, 2) pixels of the features.
        names: name of each frame.
        warnings: what reading the video reported.
    """

    size: tuple[int, int]
    times: list[float] = field(default_factory=list)
    ids: list[I64] = field(default_factory=list)
    uv: list[F64] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def part(self, first: int, end: int) -> TrackLog:
        """Frames from `first` up to, but not including, `end`."""
        frames = slice(first, end)
        return TrackLog(self.size, self.times[frames], self.ids[frames], self.uv[frames], self.names[frames])

    def frames(self) -> Iterator[Frame]:
        """Frames without their images."""
        for number, (time, name) in enumerate(zip(self.times, self.names, strict=True)):
            yield Frame(number, time, NO_IMAGE, name)

    @classmethod
    def read(cls, path: Path) -> TrackLog | None:
        """Log written by a `RecordingTracker`; None if there is none, or it is damaged.

        Observations stay in the file until they are used, so that a log of hours fits in memory.
        """
        try:
            tree = json.loads(_index(path).read_text(encoding="utf-8"))
            ends = np.cumsum(tree["counts"])
            records = np.asarray(np.memmap(path, RECORD, "r", shape=(int(ends[-1]),)))
            ids, uv = (np.split(records[name], ends[:-1]) for name in ("id", "uv"))
            return cls(tuple(tree["size"]), tree["times"], ids, uv, tree["names"], tree["warnings"])
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            return None


class RecordingTracker:
    """A `slam.trackers.Tracker` that appends what another one observes to a file, from which `TrackLog.read` reads it.

    A frame's record holds all features that were tracked into it, before any was dropped, and those detected in it. An
    hour at 10 frames per second takes 0.3 GB.
    """

    STATE = ("counts",)
    PARTS = ("tracker",)

    def __init__(self, tracker: Tracker, camera: Camera, path: Path) -> None:
        """`tracker`: does the tracking; `camera`: that of its frames; `path`: file to write."""
        self.tracker, self.counts = tracker, list[int]()
        self._camera, self._path = camera, path
        self._records: int | None = None  # written so far; None: nothing in this process
        self._damaged = False

    @property
    def tracks(self) -> Tracks:
        """Tracks in the last frame."""
        return self.tracker.tracks

    @tracks.setter
    def tracks(self, tracks: Tracks) -> None:
        self.tracker.tracks = tracks

    @property
    def images(self) -> list[U8]:
        """Virtual views of the last frame."""
        return self.tracker.images

    @images.setter
    def images(self, images: list[U8]) -> None:
        self.tracker.images = images

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """See `Tracker.track`."""
        share = self.tracker.track(grey, expected)
        self.counts.append(0)
        self._append(self.tracks)
        return share

    def drop(self, ids: I64) -> None:
        """See `Tracker.drop`."""
        self.tracker.drop(ids)

    def refill(self) -> int:
        """See `Tracker.refill`."""
        before = self.tracks.ids
        added = self.tracker.refill()
        self._append(self.tracks.keep(~np.isin(self.tracks.ids, before)))
        return added

    def finish(self, times: list[float], names: list[str], warnings: list[str]) -> None:
        """Complete the log with the times and names of its frames, and what reading the video reported."""
        if self._damaged:
            return
        tree = {
            "size": (self._camera.width, self._camera.height), "counts": self.counts, "times": times, "names": names,
            "warnings": warnings,
        }  # fmt: skip
        work = self._path.with_suffix(".part")
        work.write_text(json.dumps(tree), encoding="utf-8")
        work.replace(_index(self._path))

    def _append(self, tracks: Tracks) -> None:
        """Append observations of the last frame; what was written after a checkpoint is overwritten."""
        records = np.zeros(len(tracks), RECORD)
        records["id"], records["uv"] = tracks.ids, project_exactly(self._camera, tracks.bearing)[0]
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if self._records is None:  # a new run, or one resumed from a checkpoint
            self._records = sum(self.counts)
            self._damaged = self._records * RECORD.itemsize > _bytes(self._path)
        if not self._damaged:
            with open(self._path, "r+b" if self._records else "wb") as file:
                file.seek(self._records * RECORD.itemsize)
                file.write(records.tobytes())
                file.truncate()
        self._records += len(records)
        self.counts[-1] += len(records)


def _bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _index(path: Path) -> Path:
    """File of frame times, names and numbers of observations beside a log file."""
    return path.with_suffix(".json")


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
    """A `slam.trackers.Tracker` that replays a track log, as seen through a given camera.

    Features that the recorded run dropped end there; those dropped in the replay don't come back.
    """

    STATE = ("tracks", "_frame", "_dropped")

    def __init__(self, log: TrackLog, camera: Camera) -> None:
        self.tracks = Tracks()
        self.images: list[U8] = [np.zeros((64, 64), np.uint8)]
        self._log, self._camera, self._frame = log, camera, -1
        self._now = Tracks()
        self._dropped = np.zeros(0, np.int64)

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Advance to the next frame of the log; returns the share of tracks that continue."""
        self._frame += 1
        ids = np.asarray(self._log.ids[self._frame], np.int64)
        bearing = unproject(self._camera, np.asarray(self._log.uv[self._frame], np.float64))
        before, self._now = self.tracks, Tracks(ids, bearing).keep(np.isfinite(bearing[:, 0]))
        self._dropped = np.intersect1d(self._dropped, ids)
        self.tracks = self._now.keep(np.isin(self._now.ids, before.ids))
        return len(self.tracks) / max(len(before), 1)

    def drop(self, ids: I64) -> None:
        """Stop tracking these ids."""
        self._dropped = np.union1d(self._dropped, ids)
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        """Add all tracks of the frame that weren't dropped; returns how many were added."""
        before = len(self.tracks)
        self.tracks = self._now.keep(~np.isin(self._now.ids, self._dropped))
        return len(self.tracks) - before


def replay(log: TrackLog, camera: Camera, params: OdometryParams) -> Odometry:
    """Run odometry over a track log, as if it had been recorded by `camera`."""
    odometry = Odometry(camera, params, tracker=Replay(log, camera), keep=True)
    for time in log.times:
        odometry.add(time, NO_IMAGE)
    return odometry
