"""Encoding: a video made smaller, slower and worse, as a vehicle's link would have it (D3.2, tables 4 and 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.pipeline.io.images.image import read_rgb
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.slam.video import Video, _files


def encode(video: Video, file: Path, *, size: tuple[int, int], bitrate: float, rate: float) -> float:
    """Write a video scaled down, at a lower rate, compressed (libx264, superfast); returns its seconds.

    Args:
        video: the source.
        file: to be written.
        size: pixels, (width, height), even.
        bitrate: Mbit/s that are aimed at.
        rate: frames a second; times of frames stay those of the source.

    Raises:
        InputError: the source has fewer than two frames.
    """
    chosen, last, start = -1, 0.0, 0.0
    with Encoder(file, size, rate, bitrate=1e6 * bitrate, preset="superfast") as encoder:
        for time, picture in _pictures(video, size):
            # a frame whenever the slower clock ticks: times stay those of the source
            tick = math.floor((time + 0.25 / video.fps) * rate)
            if tick > chosen or rate > 0.98 * video.fps:
                start = time if chosen < 0 else start
                chosen, last = tick, time
                encoder.add(picture(), time)
    if encoder.count < 2:
        raise InputError(video.path, f"has {encoder.count} frames", "Give a longer video")
    return (last - start) * encoder.count / (encoder.count - 1)


def _pictures(video: Video, size: tuple[int, int]) -> Iterator[tuple[float, Callable[[], U8]]]:
    """Times from the first frame, and what makes the frame as planar YUV (H * 3 / 2, W), scaled."""
    if video.path.is_dir():
        times = np.arange(video.count or 0) / video.fps if video.times is None else video.times
        for time, path in zip(times.tolist(), _files(video.path), strict=True):
            yield time, lambda path=path: _of_picture(path, size)  # type: ignore[misc]
        return
    import av

    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        first: float | None = None
        try:
            for number, frame in enumerate(container.decode(stream)):
                time = number / video.fps if frame.time is None else frame.time
                first = time if first is None else first

                def picture(frame: Any = frame) -> U8:
                    if frame.format.name not in ("yuv420p", "yuvj420p"):
                        frame = frame.reformat(format="yuv420p")
                    planes = [_plane(plane) for plane in frame.planes]
                    return _planar(planes[0], planes[1], planes[2], size)

                yield time - first, picture
        except av.error.FFmpegError:
            return  # what could be read is what there is; `track` tells of it


def _plane(plane: Any) -> U8:
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


def _of_picture(path: Path, size: tuple[int, int]) -> U8:
    import cv2

    small = cv2.resize(read_rgb(path), size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2YUV_I420)


def _planar(y: U8, u: U8, v: U8, size: tuple[int, int]) -> U8:
    """(H * 3 / 2, W) of planes of any size."""
    import cv2

    width, height = size
    out = np.empty((height * 3 // 2, width), np.uint8)
    out[:height] = y if y.shape == (height, width) else cv2.resize(y, size, interpolation=cv2.INTER_AREA)
    half = (width // 2, height // 2)
    colour = [p if p.shape == half[::-1] else cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in (u, v)]
    out[height:] = np.concatenate([np.ascontiguousarray(p).reshape(-1) for p in colour]).reshape(-1, width)
    return out


def scaled(camera: Camera, height: int) -> Camera:
    """The camera of frames scaled to a height, and to an even width."""
    width = 2 * round(height * camera.width / camera.height / 2)
    return camera.resized(width, height)
