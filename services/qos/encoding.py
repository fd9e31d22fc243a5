"""Choose how images are encoded so that they fit a link: JPEG quality and scale, or bit rate of an H.264 stream.

Sizes are measured by encoding the images; protocol overhead is added. `bench/toolboxes/quality.py` measures the effect
on accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import U8

JPEG_QUALITIES = (90, 85, 80, 75, 70, 65, 60, 55, 50, 45, 40, 35, 30)
"""JPEG qualities, best first. Outside this range, changing the scale is more efficient than changing the quality."""
IMAGE_SCALES = (1.0, 0.75, 0.5, 0.35, 0.25)
TCP_PAYLOAD_BYTES, TCP_HEADER_BYTES = 1448, 66
"""Payload of a TCP segment, and its headers (Ethernet 14, IP 20, TCP with timestamps 32)."""
HTTP_OVERHEAD_BYTES = 3000
"""Size of a request's headers and its response: some dozen results in JSON."""
RTP_PAYLOAD_BYTES, RTP_HEADER_BYTES = 1400, 54
"""Payload of an RTP packet, and its headers (Ethernet 14, IP 20, UDP 8, RTP 12)."""
H264_BITRATES = tuple(40e6 * 0.85**step for step in range(48))
"""Bit rates of H.264 streams, highest first, down to 20 kbit/s."""


class ChoiceParams(Params):
    """Settings of `scan2sim qos choose`."""

    images: Annotated[File, Field(description="Folder of images, an image or a video.")]
    rate: Annotated[float, Field(ge=0.01, le=1000, description="Images per second.")] = 10.0
    budget: Annotated[
        float, Field(ge=0.01, le=10_000, description="Available bandwidth in Mbit/s, including overhead.")
    ] = 5.0
    weights: Annotated[
        File | None,
        Field(description="ONNX file of the detector that measures the accuracy. Default: the project's own."),
    ] = None


@dataclass(frozen=True)
class Jpeg:
    """Encoding as JPEGs.

    Attributes:
        quality: JPEG quality, 1 to 100 as in libjpeg.
        scale: scale of width and height.
        megabits: required bandwidth in Mbit/s, including overhead.
    """

    quality: int
    scale: float
    megabits: float

    def encoded(self, image: U8) -> bytes:
        """Encode an (H, W, 3) RGB image."""
        return jpeg(scaled(image, self.scale), self.quality)


@dataclass(frozen=True)
class H264:
    """Encoding as an H.264 stream: bit rate of the encoder in bit/s, and required bandwidth in Mbit/s with overhead."""

    bitrate: float
    megabits: float


def http_wire_bytes(size: int) -> int:
    """Bytes on the wire, both ways, for posting an image of `size` bytes and receiving its results."""
    segments = -(-size // TCP_PAYLOAD_BYTES)
    return size + segments * TCP_HEADER_BYTES + segments // 2 * TCP_HEADER_BYTES + HTTP_OVERHEAD_BYTES


def rtp_wire_bytes(size: int) -> int:
    """Bytes on the wire for a video frame of `size` bytes."""
    return size + -(-size // RTP_PAYLOAD_BYTES) * RTP_HEADER_BYTES


def choose_jpeg(images: Sequence[U8], rate: float, budget: float) -> Jpeg:
    """The best JPEG encoding that fits: reduce the quality, then the scale, then the quality again.

    Args:
        images: (H, W, 3) RGB; the largest one has to fit.
        rate: images per second.
        budget: available bandwidth in Mbit/s.

    Raises:
        InputError: even the smallest images need more.
    """
    least = math.inf
    for scale in IMAGE_SCALES:
        smaller = [scaled(image, scale) for image in images]
        for quality in JPEG_QUALITIES:
            made = Jpeg(quality, scale, _megabits(smaller, rate, quality))
            if made.megabits <= budget:
                return made
            least = min(least, made.megabits)
    cause = f"not enough for {rate:g} images per second, which need at least {least:.2g} Mbit/s"
    raise InputError(f"{budget:g} Mbit/s", cause, BUDGET_REMEDY)


def jpeg_at_quality(images: Sequence[U8], rate: float, quality: int) -> Jpeg:
    """JPEG encoding with a given quality, at the original size."""
    return Jpeg(quality, 1.0, _megabits(images, rate, quality))


def _megabits(images: Sequence[U8], rate: float, quality: int) -> float:
    """Bandwidth in Mbit/s if all images were as large as the largest."""
    return 8e-6 * rate * max(http_wire_bytes(len(jpeg(image, quality))) for image in images)


def choose_h264(images: Sequence[U8], rate: float, budget: float) -> H264:
    """H.264 encoding with the highest bit rate that fits.

    Args:
        images: (H, W, 3) RGB, in sequence; their size in any second has to fit.
        rate: images per second.
        budget: available bandwidth in Mbit/s.

    Raises:
        InputError: even the lowest bit rate needs more.
        UnavailableError: PyAV isn't installed.
    """
    for bitrate in (one for one in H264_BITRATES if one <= budget * 1e6):
        megabits = peak_megabits([rtp_wire_bytes(len(packet)) for packet in encode_h264(images, rate, bitrate)], rate)
        if megabits <= budget:
            return H264(bitrate, megabits)
    raise InputError(f"{budget:g} Mbit/s", f"not enough for H.264 at {rate:g} images per second", BUDGET_REMEDY)


BUDGET_REMEDY = "Send fewer or smaller images, or increase the budget"


def peak_megabits(sizes: Sequence[int], rate: float) -> float:
    """Bandwidth in Mbit/s of the second with the most bytes, from the sizes of successive frames."""
    span = max(1, min(len(sizes), round(rate)))
    sums = np.convolve(sizes, np.ones(span), "valid")
    return float(8e-6 * sums.max() * rate / span)


def scaled(image: U8, scale: float) -> U8:
    """An image resized by a factor."""
    import cv2

    if scale == 1.0:
        return image
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(image: U8, quality: int) -> bytes:
    """Encode an (H, W, 3) RGB image as a JPEG."""
    import cv2

    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def encode_h264(images: Sequence[U8], rate: float, bitrate: float) -> Iterator[bytes]:
    """Encode frames as an H.264 live stream: no frame depends on a later one, and no second exceeds the bit rate.

    Args:
        images: (H, W, 3) RGB, in sequence; an odd last row or column is cropped.
        rate: images per second.
        bitrate: bits per second.

    Raises:
        UnavailableError: PyAV isn't installed.
    """
    require("H.264", "av")
    import av

    height, width = (side // 2 * 2 for side in images[0].shape[:2])
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate = Fraction(rate).limit_denominator(1001)
    encoder.time_base = 1 / encoder.framerate
    encoder.bit_rate, encoder.gop_size = round(bitrate), max(1, round(2 * rate))
    half = str(round(bitrate / 2))  # buffer of half a second
    encoder.options = {"preset": "veryfast", "tune": "zerolatency", "maxrate": str(round(bitrate)), "bufsize": half}
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
        frame.pts = number
        yield b"".join(bytes(packet) for packet in encoder.encode(frame))


def decode_h264(packets: Sequence[bytes]) -> Iterator[U8]:
    """Decode an H.264 stream to (H, W, 3) RGB frames.

    Raises:
        UnavailableError: PyAV isn't installed.
    """
    require("H.264", "av")
    import av

    decoder = av.CodecContext.create("h264", "r")
    for one in (*packets, None):
        for frame in decoder.decode(av.Packet(one) if one else None):
            yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
