"""How images are sent so that they fit a link: the quality and scale of JPEGs, or the bit rate of an H.264 stream.

What is counted are the images' own bytes, encoded here, with the overhead of what carries them. What a choice costs in
accuracy `bench/toolboxes/quality.py` measures.
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
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import U8

QUALITIES = (90, 85, 80, 75, 70, 65, 60, 55, 50, 45, 40, 35, 30)
"""Of JPEGs, best first; above and below them a byte buys less than in the next scale."""
SCALES = (1.0, 0.75, 0.5, 0.35, 0.25)
SEGMENT, HEADERS = 1448, 66
"""Bytes of a TCP segment's load, and of its headers (Ethernet 14, IP 20, TCP with timestamps 32)."""
ANSWER = 3000
"""Bytes of a request's headers and its answer: some dozen results, in JSON."""
PACKET, PACKET_HEADERS = 1400, 54
"""Bytes of an RTP packet's load, and of its headers (Ethernet 14, IP 20, UDP 8, RTP 12)."""
BITRATES = tuple(40e6 * 0.85**step for step in range(48))
"""Of streams, highest first, down to 20 kbit/s."""


class ChoiceParams(Params):
    """Of a choice."""

    images: Annotated[File, Field(description="Folder of pictures, a picture or a video.")]
    rate: Annotated[float, Field(ge=0.01, le=1000, description="Images a second.")] = 10.0
    budget: Annotated[float, Field(ge=0.01, le=10_000, description="Mbit/s that they may take, overhead and all.")] = (
        5.0
    )


@dataclass(frozen=True)
class Jpeg:
    """How images are sent as JPEGs.

    Attributes:
        quality: as libjpeg counts it, 1 to 100.
        scale: of their sides.
        megabits: Mbit/s that they take, overhead and all.
    """

    quality: int
    scale: float
    megabits: float

    def encoded(self, image: U8) -> bytes:
        """An (H, W, 3) RGB image."""
        return jpeg(scaled(image, self.scale), self.quality)


@dataclass(frozen=True)
class H264:
    """How images are streamed: bits a second that the encoder is told, Mbit/s that it takes, overhead and all."""

    bitrate: float
    megabits: float


def by_http(size: int) -> int:
    """Bytes on the wire, both ways, of an image of so many that is posted, and of its answer."""
    segments = -(-size // SEGMENT)
    return size + segments * HEADERS + segments // 2 * HEADERS + ANSWER


def by_rtp(size: int) -> int:
    """Bytes on the wire of a stream's picture of so many."""
    return size + -(-size // PACKET) * PACKET_HEADERS


def choose_jpeg(images: Sequence[U8], rate: float, budget: float) -> Jpeg:
    """The best JPEGs that fit: first the quality is lowered, then the size, and the quality anew.

    Args:
        images: (H, W, 3) RGB; the largest of them has to fit.
        rate: images a second.
        budget: Mbit/s.

    Raises:
        InputError: even the smallest take more.
    """
    least = math.inf
    for scale in SCALES:
        smaller = [scaled(image, scale) for image in images]
        for quality in QUALITIES:
            made = Jpeg(quality, scale, _megabits(smaller, rate, quality))
            if made.megabits <= budget:
                return made
            least = min(least, made.megabits)
    raise InputError(f"{budget:g} Mbit/s", f"are too few for {rate:g} images a second: {least:.2g} are needed", FEWER)


def as_jpeg(images: Sequence[U8], rate: float, quality: int) -> Jpeg:
    """What JPEGs of a quality take, at so many images a second."""
    return Jpeg(quality, 1.0, _megabits(images, rate, quality))


def _megabits(images: Sequence[U8], rate: float, quality: int) -> float:
    """Mbit/s, were all as large as the largest."""
    return 8e-6 * rate * max(by_http(len(jpeg(image, quality))) for image in images)


def choose_h264(images: Sequence[U8], rate: float, budget: float) -> H264:
    """The highest bit rate whose stream fits.

    Args:
        images: (H, W, 3) RGB, in a row; what they take over any second has to fit.
        rate: images a second.
        budget: Mbit/s.

    Raises:
        InputError: no stream is so small.
        UnavailableError: PyAV isn't installed.
    """
    for bitrate in (one for one in BITRATES if one <= budget * 1e6):
        megabits = busiest([by_rtp(len(packet)) for packet in stream(images, rate, bitrate)], rate)
        if megabits <= budget:
            return H264(bitrate, megabits)
    raise InputError(f"{budget:g} Mbit/s", f"are too few for {rate:g} images a second", FEWER)


FEWER = "Send fewer images a second, or smaller ones, or allow more"


def busiest(sizes: Sequence[int], rate: float) -> float:
    """Mbit/s of the second with the most bytes, of pictures in a row."""
    span = max(1, min(len(sizes), round(rate)))
    sums = np.convolve(sizes, np.ones(span), "valid")
    return float(8e-6 * sums.max() * rate / span)


def scaled(image: U8, scale: float) -> U8:
    """An image whose sides are so many times as long."""
    import cv2

    if scale == 1.0:
        return image
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(image: U8, quality: int) -> bytes:
    """An (H, W, 3) RGB image as a JPEG."""
    import cv2

    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def stream(images: Sequence[U8], rate: float, bitrate: float) -> Iterator[bytes]:
    """Pictures of an H.264 stream, as a robot sends it live: none waits for a later one, no second is over the rate.

    Args:
        images: (H, W, 3) RGB, in a row; an odd row or column at the end is cut off.
        rate: images a second.
        bitrate: bits a second.

    Raises:
        UnavailableError: PyAV isn't installed.
    """
    need("H.264", "av")
    import av

    height, width = (side // 2 * 2 for side in images[0].shape[:2])
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate = Fraction(rate).limit_denominator(1001)
    encoder.time_base = 1 / encoder.framerate
    encoder.bit_rate, encoder.gop_size = round(bitrate), max(1, round(2 * rate))
    half = str(round(bitrate / 2))  # seconds that may be ahead of the rate
    encoder.options = {"preset": "veryfast", "tune": "zerolatency", "maxrate": str(round(bitrate)), "bufsize": half}
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
        frame.pts = number
        yield b"".join(bytes(packet) for packet in encoder.encode(frame))


def pictures(packets: Sequence[bytes]) -> Iterator[U8]:
    """(H, W, 3) RGB of a stream's pictures.

    Raises:
        UnavailableError: PyAV isn't installed.
    """
    need("H.264", "av")
    import av

    decoder = av.CodecContext.create("h264", "r")
    for one in (*packets, None):
        for frame in decoder.decode(av.Packet(one) if one else None):
            yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
