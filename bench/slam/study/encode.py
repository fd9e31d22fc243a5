"""Step `encode`: re-encodes a video at the resolution, frame rate and bitrate of a vehicle's link."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from bench.slam.study.video_degradation import encode
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Rate
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.io.images.video import check_encoder
from scan2sim.slam.video import open_video

Pixels = Annotated[int, Field(ge=2, le=100_000, multiple_of=2)]


class EncodedVideo(Context):
    """The encoded video: a cell of the study's tables.

    Attributes:
        size: width and height, even numbers of pixels.
        bitrate: target bitrate, Mbit/s.
        rate: frames per second.
        fps: frames per second of a source that is a folder of images.
    """

    size: tuple[Pixels, Pixels] = (2048, 1024)
    bitrate: Annotated[float, Field(ge=0.01, le=10_000)] = 10.0
    rate: Rate = 30.0
    fps: Rate = 10.0


class EncodeParams(Params):
    """No settings."""

    context: EncodedVideo = EncodedVideo()


def encode_video(inputs: Inputs, params: EncodeParams, out: Path, report: Report) -> Done:
    """Re-encode `video` at a lower resolution, frame rate and bitrate."""
    file = out / "video.mp4"
    wanted = params.context
    video = open_video(inputs["video"], fps=wanted.fps)
    seconds = encode(video, file, size=wanted.size, bitrate=wanted.bitrate, rate=wanted.rate)
    metrics = {"width": wanted.size[0], "mbit_s": round(8e-6 * file.stat().st_size / seconds, 4)}
    return Done({"video": file}, metrics)


def can_encode(params: Any) -> None:
    """Raise UnavailableError if PyAV or matplotlib isn't installed, or H.264 can't be encoded."""
    require("bench.slam.study", "av", "matplotlib")
    check_encoder("bench.slam.study")


ENCODE = Step("encode", 1, encode_video, EncodeParams, check=can_encode)
