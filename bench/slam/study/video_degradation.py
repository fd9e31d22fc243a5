"""Video degradation: reduces resolution, frame rate and bitrate to those of a vehicle's link (D3.2, tables 4 and 5)."""

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
    """Write a video at a lower resolution, frame rate and bitrate (libx264, superfast); returns its duration, seconds.

    Args:
        video: the source.
        file: video to write.
        size: (width, height), even numbers of pixels.
        bitrate: target bitrate, Mbit/s.
        rate: frames per second; frames keep their times in the source.

    Raises:
        InputError: the source has fewer than two frames.
    """
    chosen, last, start = -1, 0.0, 0.0
    with Encoder(file, size, rate, bitrate=1e6 * bitrate, preset="superfast") as encoder:
        for time, yuv in _yuv_frames(video, size):
            # take one frame per tick of the lower rate, with its time in the source
            tick = math.floor((time + 0.25 / video.fps) * rate)
            if tick > chosen or rate > 0.98 * video.fps:
                start = time if chosen < 0 else start
                chosen, last = tick, time
                encoder.add(yuv(), time)
    if encoder.count < 2:
        raise InputError(video.path, f"has {encoder.count} frames", "Give a longer video")
    return (last - start) * encoder.count / (encoder.count - 1)


def _yuv_frames(video: Video, size: tuple[int, int]) -> Iterator[tuple[float, Callable[[], U8]]]:
    """Per frame: seconds since the first one, and a function that returns it scaled, as planar YUV (H * 3 / 2, W)."""
    if video.path.is_dir():
        times = np.arange(video.count or 0) / video.fps if video.times is None else video.times
        for time, path in zip(times.tolist(), _files(video.path), strict=True):
            yield time, lambda path=path: _yuv_of_image(path, size)  # type: ignore[misc]
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

                def yuv(frame: Any = frame) -> U8:
                    if frame.format.name not in ("yuv420p", "yuvj420p"):
                        frame = frame.reformat(format="yuv420p")
                    planes = [_plane(plane) for plane in frame.planes]
                    return _planar(planes[0], planes[1], planes[2], size)

                yield time - first, yuv
        except av.error.FFmpegError:
            return  # use the readable part; the track step warns about the rest


def _plane(plane: Any) -> U8:
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


def _yuv_of_image(path: Path, size: tuple[int, int]) -> U8:
    import cv2

    small = cv2.resize(read_rgb(path), size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2YUV_I420)


def _planar(y: U8, u: U8, v: U8, size: tuple[int, int]) -> U8:
    """(H * 3 / 2, W) planar YUV 4:2:0 image, scaled from planes of any size."""
    import cv2

    width, height = size
    out = np.empty((height * 3 // 2, width), np.uint8)
    out[:height] = y if y.shape == (height, width) else cv2.resize(y, size, interpolation=cv2.INTER_AREA)
    half = (width // 2, height // 2)
    colour = [p if p.shape == half[::-1] else cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in (u, v)]
    out[height:] = np.concatenate([np.ascontiguousarray(p).reshape(-1) for p in colour]).reshape(-1, width)
    return out


def scaled(camera: Camera, height: int) -> Camera:
    """Camera of frames scaled to a height, and to the nearest even width."""
    width = 2 * round(height * camera.width / camera.height / 2)
    return camera.resized(width, height)
