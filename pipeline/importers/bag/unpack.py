"""Unpacks a bag into files that the importer of sweeps reads: one pass over the messages, a few sweeps in memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.bag import images
from scan2sim.pipeline.importers.bag.contents import GAP_RATIO, MIN_GAP_S, decode_sweep, inspected
from scan2sim.pipeline.importers.bag.images import InvalidImage
from scan2sim.pipeline.importers.bag.plan import BagParams, Lidar, PhotoSource, plan_import
from scan2sim.pipeline.importers.bag.point_cloud2 import (
    MAX_OFFSET_S,
    InvalidCloud,
    RawSweep,
    TimeUnit,
    intensity_scale,
    time_unit,
)
from scan2sim.pipeline.importers.bag.poses import PoseMessages
from scan2sim.pipeline.importers.bag.reader import Bag, Message, opened
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.rig import RigCamera, write_rig
from scan2sim.pipeline.io.sweep_files import Sweep, time_stem, write_sweep

MAX_CLOCK_STEP_S = 10.0
"""Largest change of the difference between a sensor's clock and that of the recorder."""
MAX_BACK_S = 1.0
"""Messages may be recorded out of order by less than this."""
MAX_AFTER_S = 0.03
"""Points that are later than the recording of their message by more than this have wrong times."""
MERGE_WINDOW_NS = 500_000_000
"""Sweeps of several lidars are merged with the nearest of the first lidar within this time."""


@dataclass(frozen=True)
class Unpacked:
    """Files of a recording: folders of sweeps and of photos (a rig), trajectory and GPS track; None without."""

    sweeps: Path
    photos: Path | None
    poses: Path | None
    gps: Path | None
    metrics: dict[str, Any]


@dataclass
class _Clock:
    """Time of the messages of a topic; rejects jumps."""

    bag: Bag
    log_times: bool
    last_ns: int | None = None
    offset_ns: int = 0

    def time(self, message: Message) -> int | None:
        """Nanoseconds; None for a second message of the same time.

        Raises:
            InputError: the clock jumped.
        """
        time = message.log_ns if self.log_times else self.bag.header(message).stamp_ns
        if self.last_ns is None:
            self.offset_ns = message.log_ns - time
        elif time == self.last_ns:
            if time == 0:
                raise self.bag.bad(message, "has no time stamp in its header", "Use --stamps log")
            return None
        else:
            self._check(message, time, self.last_ns)
        self.last_ns = time
        return time

    def _check(self, message: Message, time: int, last: int) -> None:
        back, step = (last - time) / 1e9, (message.log_ns - time - self.offset_ns) / 1e9
        if back > MAX_BACK_S:
            cause = f"is {back:.1f} s before the previous one: a clock was set back"
        elif abs(step) > MAX_CLOCK_STEP_S:
            cause = f"has a time stamp that jumped by {-step:.1f} s against the time of recording"
        else:
            return
        other = "Split the bag there" if self.log_times else "Use --stamps log, or split the bag there"
        raise self.bag.bad(message, cause, other)


@dataclass
class _Skipped:
    """Messages that are left out: their number, and what is wrong with the first one, by topic."""

    counts: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)

    def add(self, bag: Bag, message: Message, cause: str) -> None:
        self.counts[message.topic] += 1
        self.first.setdefault(message.topic, f"the first, of {bag.at(message)}, {cause}")

    def warnings(self) -> list[str]:
        return [
            f"{count} of {topic}'s messages are left out: {self.first[topic]}" for topic, count in self.counts.items()
        ]


@dataclass
class _LidarDecoder:
    """Decodes sweeps of one lidar; the unit of its times and intensities is recognized by its first sweeps."""

    lidar: Lidar
    log_times: bool
    unit: TimeUnit | None = None
    scale: float | None = None
    _after: list[float] = field(default_factory=list)

    def sweep(self, raw: RawSweep, message: Message, time_ns: int, stamp_ns: int, timed: bool) -> Sweep:
        """The sweep in the axes of the first lidar, its points' times in the clock of `time_ns`.

        Args:
            raw: the points.
            message: that of the points.
            time_ns: its time.
            stamp_ns: time stamp of its header.
            timed: whether the sweeps have times of points.

        Raises:
            InvalidCloud: times of points are far from that of the message.
        """
        if raw.time is not None and self.unit is None:
            self.unit = time_unit(raw.time, stamp_ns)
        intensity = np.zeros(len(raw), np.uint16)
        if raw.intensity is not None:
            if self.scale is None:
                self.scale = intensity_scale(raw.intensity)
            levels = np.nan_to_num(raw.intensity.astype(np.float64)) * (self.scale * 65535)
            intensity = np.clip(np.rint(levels), 0, 65535).astype(np.uint16)
        xyz = raw.xyz
        if not np.array_equal(self.lidar.T_scanner_lidar, np.eye(4)):
            T = self.lidar.T_scanner_lidar
            xyz = (raw.xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        times: F64 | None = None
        if timed:
            offsets = np.zeros(len(raw))
            if self.unit is not None and raw.time is not None:
                offsets = self.unit.offsets(raw.time, stamp_ns)
            farthest = float(np.abs(offsets).max())
            if farthest >= MAX_OFFSET_S:
                raise InvalidCloud(f"has points whose times are {farthest:.1f} s from that of the message")
            if self.log_times:
                offsets -= offsets.max()  # a message is recorded after its last point
            times = time_ns * 1e-9 + offsets
            delay = (message.log_ns - stamp_ns) * 1e-9
            if 0 < delay < MAX_OFFSET_S and not self.log_times:  # 0: of a converted bag
                self._after.append(float(offsets.max()) - delay)
        return Sweep(xyz, intensity, raw.rgb, times)

    def warnings(self) -> list[str]:
        """Assumptions about the times of points."""
        topic = self.lidar.topic
        if self._after and float(np.median(self._after)) > MAX_AFTER_S:
            return [
                f"the last points of {topic} are {np.median(self._after):.2f} s later than the recording of their "
                "message: its time stamp is probably that of the end of the sweep, or its clock is wrong"
            ]
        if self.lidar.timed and self.unit is None:
            return [f"the times of the points of {topic} have no plausible unit: they are not used"]
        if self.unit is not None and self.unit.other_clock:
            return [
                f"the points of {topic} have times in another clock than the messages: a message's time is taken as "
                "that of its first point"
            ]
        return []


@dataclass
class _SweepWriter:
    """Writes sweeps of the first lidar, each with those of the others that are nearest in time."""

    folder: Path
    several: bool
    times: list[int] = field(default_factory=list)
    points: int = 0
    dropped: int = 0
    _first: list[tuple[int, Sweep]] = field(default_factory=list)
    _others: list[tuple[int, Sweep]] = field(default_factory=list)

    def add(self, time_ns: int, sweep: Sweep, first: bool) -> None:
        """Add a sweep; those that no later sweep can belong to are written."""
        (self._first if first else self._others).append((time_ns, sweep))
        self.flush(time_ns - MERGE_WINDOW_NS if self.several else time_ns)

    def flush(self, until_ns: int | None = None) -> None:
        """Write the sweeps of the first lidar up to a time; None: all."""
        while self._first and (until_ns is None or self._first[0][0] <= until_ns):
            time_ns, sweep = self._first[0]
            near, far = list[Sweep](), list[tuple[int, Sweep]]()
            known = np.array([t for t, _ in self._first])
            for other, points in self._others:
                nearest = int(np.abs(known - other).argmin())
                if nearest == 0 and abs(other - time_ns) <= MERGE_WINDOW_NS:
                    near.append(points)
                else:
                    far.append((other, points))
            self._others = far
            self._first.pop(0)
            self._write(time_ns, joined([sweep, *near]))
        kept = [one for one in self._others if until_ns is not None and one[0] >= until_ns - MERGE_WINDOW_NS]
        self.dropped += len(self._others) - len(kept)
        self._others = kept

    def _write(self, time_ns: int, sweep: Sweep) -> None:
        write_sweep(self.folder / f"{time_stem(time_ns)}.ply", sweep)
        self.times.append(time_ns)
        self.points += len(sweep.xyz)


def joined(sweeps: list[Sweep]) -> Sweep:
    """The points of sweeps in the same axes; colours and times are kept if all have them."""
    if len(sweeps) == 1:
        return sweeps[0]

    def column(name: str) -> Any:
        values = [getattr(sweep, name) for sweep in sweeps]
        return None if any(value is None for value in values) else np.concatenate(values)

    return Sweep(column("xyz"), column("intensity"), column("rgb"), column("time"))


def unpack(
    path: Path,
    out: Path,
    params: BagParams,
    *,
    intrinsics: Path | None = None,
    urdf: Path | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Unpacked:
    """Write sweeps, photos, calibration and poses of a bag into the folder `out`.

    Sweeps are .ply files in the axes of the first lidar, named by their time in seconds; photos are in a folder for
    each camera of a rig (`pipeline.io.rig`). Poses are the scanner's.

    Args:
        path: the bag.
        out: folder to write to.
        params: choice of topics.
        intrinsics: file with the cameras, instead of CameraInfo.
        urdf: description of the robot: its fixed joints are static transforms.
        warn: receives omissions and assumptions.
        report: receives progress.

    Raises:
        InputError: the bag is damaged, or a transform or calibration is missing.
        DataError: it contains no sweeps or no poses. SettingError: a chosen topic isn't in it.
        UnavailableError: the package `rosbags` isn't installed.
    """
    with opened(path) as bag:
        found = inspected(bag)
        plan = plan_import(found, params, intrinsics, urdf)
        for text in plan.warnings:
            warn(text)
        log_times = params.stamps == "log"
        poses = PoseMessages.of(found, plan, log_times)
        lidars = {lidar.topic: _LidarDecoder(lidar, log_times) for lidar in plan.lidars}
        cameras = {source.topic: source for source in plan.cameras}
        clocks = {topic: _Clock(bag, log_times) for topic in (*lidars, *cameras)}
        skipped, last_photo = _Skipped(), dict[str, int]()
        wanted = {*lidars, *cameras, *poses.topics}
        read, counts = Counter(dict.fromkeys(wanted, 0)), Counter[str]()  # messages and photos by topic
        for folder in ("sweeps", *(f"photos/{source.id}" for source in plan.cameras)):
            (out / folder).mkdir(parents=True)
        writer = _SweepWriter(out / "sweeps", len(plan.lidars) > 1)
        interval = 0 if params.photo_interval is None else round(params.photo_interval * 1e9)
        duration = max(1, bag.end_ns - bag.start_ns)
        for message in bag.messages(wanted):
            report((message.log_ns - bag.start_ns) / duration, message.topic)
            read[message.topic] += 1
            if message.topic not in clocks:
                poses.add(message)
                continue
            time = clocks[message.topic].time(message)
            if time is None:
                skipped.add(bag, message, "has the same time as the one before")
                continue
            try:
                if message.topic in lidars:
                    raw = decode_sweep(bag, message)
                    if not len(raw):
                        raise InvalidCloud("has no points")
                    sweep = lidars[message.topic].sweep(raw, message, time, bag.header(message).stamp_ns, plan.timed)
                    writer.add(time, sweep, message.topic == plan.lidars[0].topic)
                elif time - last_photo.get(message.topic, time - interval) >= interval:
                    _write_photo(bag, message, cameras[message.topic], out / "photos", time)
                    last_photo[message.topic] = time
                    counts[message.topic] += 1
            except (InvalidCloud, InvalidImage) as error:
                skipped.add(bag, message, str(error))
        writer.flush()
        for topic, count in read.items():
            if count < bag.topics[topic].count:
                missing = f"{bag.topics[topic].count - count} of {bag.topics[topic].count} messages"
                warn(f"{missing} of {topic} are missing in the bag, which may be damaged")
        for text in (*skipped.warnings(), *(text for decoder in lidars.values() for text in decoder.warnings())):
            warn(text)
        topic = plan.lidars[0].topic
        if not writer.times:
            raise DataError(path, f"no sweep of {topic} has points", "Check the recording, or choose another --lidar")
        _warn_gaps(writer, topic, warn)
        kept = [source for source in plan.cameras if counts[source.topic]]
        for source in plan.cameras:
            if source not in kept:
                (out / "photos" / source.id).rmdir()
                warn(f"no image of {source.topic} is usable: it is left out")
        metrics = {
            "sweeps": len(writer.times), "points": writer.points, "photos": sum(counts.values()),
            "seconds": round((max(writer.times) - min(writer.times)) / 1e9, 3), "poses": plan.poses.setting,
        }  # fmt: skip
        trajectory, gps = _poses(poses, plan.poses.kind, out), _gps(poses, plan.gps, out)
        for text in poses.warnings:
            warn(text)
        return Unpacked(out / "sweeps", _rig(out / "photos", kept), trajectory, gps, metrics)


def _write_photo(bag: Bag, message: Message, source: PhotoSource, folder: Path, time_ns: int) -> None:
    """Write an image to the folder of its camera.

    Raises:
        InvalidImage: it is damaged, or of another size than the camera's.
    """
    image, compressed = bag.decode(message), message.type.endswith("CompressedImage")
    size = (source.camera.width, source.camera.height)
    if not compressed and (int(image.width), int(image.height)) != size:
        raise InvalidImage(f"is {image.width}x{image.height} pixels, not {size[0]}x{size[1]}")
    suffix, content = images.compressed_file(image) if compressed else images.raw_file(image)
    (folder / source.id / f"{time_stem(time_ns)}{suffix}").write_bytes(content)


def _warn_gaps(writer: _SweepWriter, topic: str, warn: Callable[[str], None]) -> None:
    if writer.dropped:
        warn(f"{writer.dropped} sweeps of other lidars are left out: there is none of {topic} at their time")
    steps = np.diff(np.sort(np.array(writer.times, np.float64))) / 1e9
    gaps = steps[steps > max(MIN_GAP_S, GAP_RATIO * float(np.median(steps)))] if len(steps) else steps
    if len(gaps):
        warn(f"{topic} has {len(gaps)} gaps of up to {gaps.max():.1f} s")


def _rig(folder: Path, cameras: list[PhotoSource]) -> Path | None:
    if not cameras:
        return None
    write_rig(folder, [RigCamera(one.id, one.camera, one.T_camera_scanner) for one in cameras])
    return folder


def _poses(poses: PoseMessages, kind: str, out: Path) -> Path | None:
    if kind == "sweeps":
        return None
    trajectory_io.write(out / "poses.csv", poses.trajectory())
    return out / "poses.csv"


def _gps(poses: PoseMessages, topic: str, out: Path) -> Path | None:
    if not topic:
        return None
    (out / "gps.csv").write_text(poses.gps_csv(), encoding="utf-8")
    return out / "gps.csv"
