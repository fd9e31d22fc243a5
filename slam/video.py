"""Video input: reads the frames of a video file, or of a folder of images, in order of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.panorama import STITCH
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images.image import SUFFIXES, read_levels

UNSTITCHED = (".insv", ".360")
"""Suffixes of what 360 cameras record: fisheye circles (Insta360), faces of a cube (GoPro)."""


@dataclass(frozen=True)
class Frame:
    """A frame: its number in the source, `time` in seconds since the first frame, `grey` (H, W) image and name."""

    number: int
    time: float
    grey: U8
    name: str


@dataclass(frozen=True)
class Video:
    """A video file, or a folder of images.

    Attributes:
        path: video file or folder.
        width, height: size of the first frame, pixels, upright.
        count: number of frames by the file's metadata; None if unknown.
        fps: frames per second by the file's metadata, or as given for a folder.
        start: UNIX time of the first frame by the file's metadata; None if unknown.
        times: (N,) seconds of a folder's images, if given.
        focal_35mm: 35 mm equivalent focal length by the file's metadata, millimetres; None if unknown.
    """

    path: Path
    width: int
    height: int
    count: int | None
    fps: float
    start: float | None
    times: F64 | None = None
    focal_35mm: float | None = None

    @property
    def first(self) -> Path:
        """First image of a folder."""
        return _files(self.path)[0]

    def first_grey(self) -> U8:
        """First frame (H, W), grey."""
        return next(self.frames()).grey

    def frames(self, *, every: int = 1, warn: Callable[[str], None] = lambda _: None) -> Iterator[Frame]:
        """Every Nth frame, N = `every`.

        Out-of-order frames are skipped; reading stops at a damaged frame or one of another size. `warn` receives a
        warning for each of these.
        """
        source = _of_folder(self) if self.path.is_dir() else _of_file(self, warn)
        last, number = -np.inf, -1
        for number, frame in enumerate(source):
            if frame.grey.shape != (self.height, self.width):
                size = f"{frame.grey.shape[1]}x{frame.grey.shape[0]}"
                warn(
                    f"frame {number} is {size} instead of {self.width}x{self.height}: the rest of the video is ignored"
                )
                return
            if frame.time <= last:
                warn(f"frame {number} is out of order ({frame.time:.3f} s after {last:.3f} s): skipped")
                continue
            last = frame.time
            if number % every == 0:
                yield frame
        if self.count is not None and number + 1 < self.count:
            warn(f"the video ends after {number + 1} of {self.count} frames")


def open_video(path: Path, *, fps: float = 10.0, times: Path | None = None) -> Video:
    """Open a video file or a folder of images, and read its metadata.

    Args:
        path: video file or folder.
        fps: frames per second of a folder's images, if `times` isn't given.
        times: text file with the times of a folder's images, seconds, one per line.

    Raises:
        InputError: there are no frames, or they can't be read.
    """
    if path.is_dir():
        return _folder(path, fps, times)
    if not path.is_file():
        raise InputError(path, "file not found", "Check the path; give a video file, or a folder of images")
    if path.suffix.lower() in UNSTITCHED:
        raise InputError(path, "is an unstitched recording of a 360 camera", STITCH)
    av = _av()
    try:
        with av.open(str(path.absolute())) as container:  # FFmpeg takes `12:30.mp4` for an address
            stream = _main_stream(container)
            if stream is None or stream.codec_context is None:
                raise InputError(path, "has no readable video stream", "Give a video file, or a folder of images")
            first = next(container.decode(stream), None)
            if first is None:
                raise InputError(path, "has no readable frame", "Copy or convert it again")
            height, width = upright(np.zeros((first.height, first.width), np.uint8), first).shape
            rate = float(stream.average_rate or stream.base_rate or 30)
            count = stream.frames or (round(stream.duration * stream.time_base * rate) if stream.duration else None)
            start = _start(container.metadata.get("creation_time") or stream.metadata.get("creation_time"))
            focal = _focal(container.metadata | stream.metadata)
            return Video(path, width, height, count, rate, start, None, focal)
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        raise InputError(path, f"isn't a readable video ({error})", "Copy or convert it again") from None


def _av() -> Any:
    require("a video", "av")
    import av

    return av


def _focal(metadata: dict[str, str]) -> float | None:
    """35 mm equivalent focal length, millimetres, from metadata as phones write it."""
    values = [text for name, text in metadata.items() if name.lower().endswith("focal_length.35mm_equivalent")]
    try:
        return next((focal for text in values if (focal := float(text)) > 1), None)
    except ValueError:
        return None


def _start(written: str | None) -> float | None:
    try:
        return datetime.fromisoformat(written).timestamp() if written else None
    except ValueError:
        return None


def _files(path: Path) -> list[Path]:
    found = (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and not file_checks.hidden(p))
    return sorted(found, key=lambda path: file_checks.natural_order(path.name))


def _folder(path: Path, fps: float, times: Path | None) -> Video:
    files = _files(path)
    if not files:
        raise InputError(path, f"holds no images ({' '.join(SUFFIXES)})", "Give a folder of images, or a video file")
    seconds = None
    if times is not None:
        try:
            seconds = np.loadtxt(times, ndmin=1).astype(np.float64)
        except (OSError, ValueError) as error:
            raise InputError(times, f"is no list of times ({error})", "Write seconds, one per line") from None
        if len(seconds) != len(files):
            raise InputError(
                times, f"has {len(seconds)} times for {len(files)} images", "Write one time for every image"
            )
        seconds = seconds - seconds[0]
    height, width = read_levels(files[0]).shape
    return Video(path, width, height, len(files), fps, None, seconds)


def _of_folder(video: Video) -> Iterator[Frame]:
    for i, path in enumerate(_files(video.path)):
        yield Frame(i, i / video.fps if video.times is None else float(video.times[i]), read_levels(path), path.name)


def _of_file(video: Video, warn: Callable[[str], None]) -> Iterator[Frame]:
    for number, (time, frame) in enumerate(decode(video, warn)):
        yield Frame(number, time, upright(_grey(frame), frame), f"{number:06d}")


def decode(video: Video, warn: Callable[[str], None]) -> Iterator[tuple[float, Any]]:
    """Decode a video file: seconds since the first frame, and PyAV's frame.

    `warn` receives a warning if the file can't be read to its end, or holds further videos.
    """
    av = _av()
    with av.open(str(video.path.absolute())) as container:
        stream = _main_stream(container)
        pictures = [s for s in container.streams.video if not s.disposition & av.stream.Disposition.attached_pic]
        if len(pictures) > 1:
            used = f"the one of {stream.codec_context.width}x{stream.codec_context.height} is used"
            warn(f"the file holds {len(pictures)} videos; {used}")
        stream.thread_type = "AUTO"
        first: float | None = None
        number = 0
        try:
            for frame in container.decode(stream):
                time = float(frame.pts * frame.time_base) if frame.pts is not None else number / video.fps
                first = time if first is None else first
                yield time - first, frame
                number += 1
        except av.error.FFmpegError as error:
            warn(f"the video can't be read beyond frame {number} ({error})")


def upright(pixels: U8, frame: Any) -> U8:
    """Pixels (H, W, ...) of PyAV's frame, turned as players show it: phones store portraits on their side."""
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))


def _main_stream(container: Any) -> Any:
    """The video, not a cover picture or a thumbnail; None without one."""
    return container.streams.best("video")


def _grey(frame: Any) -> U8:
    """(H, W) grey image: the luma plane if the frame has one."""
    if frame.format.name in ("yuv420p", "yuvj420p", "nv12", "yuv422p", "yuvj422p", "yuv444p"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        return np.ascontiguousarray(rows[: frame.height, : frame.width])
    return np.ascontiguousarray(frame.to_ndarray(format="gray"))
