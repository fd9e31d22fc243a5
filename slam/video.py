"""Video: frames of a video file, or of a folder of pictures, one at a time, in order of their times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.io.images.image import SUFFIXES, read_levels


@dataclass(frozen=True)
class Frame:
    """A frame: its number in the source, `time` in seconds from the first, `grey` (H, W) and a name."""

    number: int
    time: float
    grey: U8
    name: str


@dataclass(frozen=True)
class Video:
    """What frames come from.

    Attributes:
        path: video file or folder.
        width, height: pixels of the first frame.
        count: of frames, as the file says; None if it doesn't.
        fps: frames a second, as the file says, or as was given for a folder.
        start: UNIX time of the first frame where the file tells it, else None.
        times: (N,) seconds of a folder's pictures, where they are given.
        focal_35mm: millimetres, of film as large, where a file's metadata tell it.
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
        """The first picture of a folder."""
        return _files(self.path)[0]

    def frames(self, *, every: int = 1, warn: Callable[[str], None] = lambda _: None) -> Iterator[Frame]:
        """Every so manieth frame; frames that are damaged, of another size or out of order are left out, and told."""
        source = _of_folder(self) if self.path.is_dir() else _of_file(self, warn)
        last, number = -np.inf, -1
        for number, frame in enumerate(source):
            if frame.grey.shape != (self.height, self.width):
                size = f"{frame.grey.shape[1]}x{frame.grey.shape[0]}"
                warn(f"frame {number} is {size} instead of {self.width}x{self.height}: the video is read up to there")
                return
            if frame.time <= last:
                warn(f"frame {number} is out of order ({frame.time:.3f} s after {last:.3f} s): left out")
                continue
            last = frame.time
            if number % every == 0:
                yield frame
        if self.count is not None and number + 1 < self.count:
            warn(f"the video ends after {number + 1} of {self.count} frames")


def open_video(path: Path, *, fps: float = 10.0, times: Path | None = None) -> Video:
    """Look at a video file or a folder of pictures.

    Args:
        path: of either.
        fps: of a folder's pictures, where `times` isn't given.
        times: of a folder's pictures, seconds, one a line.

    Raises:
        InputError: there are no frames, or they can't be read.
    """
    if path.is_dir():
        return _folder(path, fps, times)
    if not path.is_file():
        raise InputError(path, "is missing", "Name a video file, or a folder of pictures")
    av = _av()
    try:
        with av.open(str(path)) as container:
            if not container.streams.video or container.streams.video[0].codec_context is None:
                raise InputError(path, "has no video stream to read", "Name a video file, or a folder of pictures")
            stream = container.streams.video[0]
            rate = float(stream.average_rate or stream.base_rate or 30)
            count = stream.frames or (round(stream.duration * stream.time_base * rate) if stream.duration else None)
            start = _start(container.metadata.get("creation_time") or stream.metadata.get("creation_time"))
            focal = _focal(container.metadata | stream.metadata)
            size = stream.codec_context.width, stream.codec_context.height
            return Video(path, *size, count, rate, start, None, focal)
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        raise InputError(path, f"is no readable video ({error})", "Copy or convert it again") from None


def _av() -> Any:
    need("a video", "av")
    import av

    return av


def _focal(metadata: dict[str, str]) -> float | None:
    """Millimetres on 35 mm film, as telephones write it."""
    told = [text for name, text in metadata.items() if name.lower().endswith("focal_length.35mm_equivalent")]
    try:
        return next((focal for text in told if (focal := float(text)) > 1), None)
    except ValueError:
        return None


def _start(written: str | None) -> float | None:
    try:
        return datetime.fromisoformat(written).timestamp() if written else None
    except ValueError:
        return None


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _files(path: Path) -> list[Path]:
    return sorted((p for p in path.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)


def _folder(path: Path, fps: float, times: Path | None) -> Video:
    files = _files(path)
    if not files:
        raise InputError(path, f"holds no pictures ({' '.join(SUFFIXES)})", "Name a folder of pictures, or a video")
    shown = None
    if times is not None:
        try:
            shown = np.loadtxt(times, ndmin=1).astype(np.float64)
        except (OSError, ValueError) as error:
            raise InputError(times, f"is no list of times ({error})", "Write seconds, one a line") from None
        if len(shown) != len(files):
            raise InputError(
                times, f"has {len(shown)} times for {len(files)} pictures", "Write a time for every picture"
            )
        shown = shown - shown[0]
    height, width = read_levels(files[0]).shape
    return Video(path, width, height, len(files), fps, None, shown)


def _of_folder(video: Video) -> Iterator[Frame]:
    for i, path in enumerate(_files(video.path)):
        yield Frame(i, i / video.fps if video.times is None else float(video.times[i]), read_levels(path), path.name)


def _of_file(video: Video, warn: Callable[[str], None]) -> Iterator[Frame]:
    av = _av()
    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        first: float | None = None
        number = 0
        try:
            for frame in container.decode(stream):
                time = float(frame.pts * frame.time_base) if frame.pts is not None else number / video.fps
                first = time if first is None else first
                grey = _grey(frame)
                yield Frame(number, time - first, grey, f"{number:06d}")
                number += 1
        except av.error.FFmpegError as error:
            warn(f"the video can't be read beyond frame {number} ({error})")


def _grey(frame: Any) -> U8:
    """(H, W): the luma plane, where the frame has one."""
    if frame.format.name in ("yuv420p", "yuvj420p", "nv12", "yuv422p", "yuvj422p", "yuv444p"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        return np.ascontiguousarray(rows[: frame.height, : frame.width])
    return np.ascontiguousarray(frame.to_ndarray(format="gray"))
