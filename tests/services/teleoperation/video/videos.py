"""Video for tests: from a camera's encoder over simulated links to a receiver, on a simulated clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import cv2
import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.cameras import CameraFrame, pattern
from scan2sim.services.teleoperation.video.capture import CameraEncoder
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, VideoReceiver
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule

FRAME_INTERVAL_NS = 33_333_333
"""Interval between frames."""
ROUND_TRIP_S = 0.09
"""Round-trip time."""
Link = Callable[[list[bytes]], Iterable[bytes]]
"""Maps sent packets to received packets."""


def scenery(width: int = 320, height: int = 240) -> Iterator[CameraFrame]:
    """Synthetic frames 33 ms apart."""
    still = cv2.GaussianBlur(pattern.bars(width, height), (0, 0), 1.5).astype(np.uint8)
    for i in range(100_000):
        yield CameraFrame(pattern.draw_at(still, i / 30), i * FRAME_INTERVAL_NS)


def psnr(a: U8, b: U8) -> float:
    """Peak signal-to-noise ratio, dB."""
    return float(cv2.PSNR(a, b))


class Drive:
    """A camera's frames, sent and received; key frame requests of the station are carried out.

    Attributes:
        frames: output by the receiver; `images`: sent, by capture time.
        key_frame_requests: their times; `nacks`: times of NACKs.
    """

    def __init__(
        self,
        key_lifetime: float = 1e9,
        plan: EncodingPlan | None = None,
        retransmits: bool = False,
        keep_images: bool = True,
    ) -> None:
        """`retransmits`: NACKed packets are retransmitted; `keep_images`: `images` is filled."""
        self.now = 0.0
        self.keys = KeySchedule(self.now, key_lifetime)
        self.encoder = CameraEncoder(3, self.keys, encoders.find("pyav"))
        self.plan = plan or EncodingPlan(bitrate=800_000)
        self.frames: list[Frame] = []
        self.key_frame_requests: list[float] = []
        self.images: dict[int, U8] = {}
        self.receiver = VideoReceiver(
            self.frames.append,
            self._request_key_frame,
            lambda sent: self.now * 1e3 - sent / 1e6,
            self._send_nack,
            lambda: ROUND_TRIP_S,
            lambda: self.now,
        )
        self.nacks: list[float] = []
        self._keep_images = keep_images
        self._retransmits, self._retransmitted = retransmits, list[tuple[float, list[bytes]]]()

    def _request_key_frame(self, camera: int) -> None:
        assert camera == 3
        self.key_frame_requests.append(self.now)
        self.encoder.request_key_frame()

    def _send_nack(self, source: int, sequences: Sequence[int]) -> None:
        self.nacks.append(self.now)
        if self._retransmits:
            self._retransmitted.append((self.now + ROUND_TRIP_S, self.encoder.retransmit(source, sequences)))

    def send(self, frames: Iterable[CameraFrame], link: Link = lambda packets: packets, name: str = "lte") -> None:
        """Send all frames."""
        for frame in frames:
            self.now = frame.captured / 1e9
            for key in self.keys.announced(self.now):
                self.receiver.add_key(key)
            if self._keep_images:
                self.images[frame.captured] = frame.image
            packets = self.encoder.encode(frame, self.plan, self.now)
            while self._retransmitted and self._retransmitted[0][0] <= self.now:
                packets = [*self._retransmitted.pop(0)[1], *packets]
            for packet in link(packets):
                self.receiver.feed(packet, name)

    def decoded(self) -> list[tuple[Frame, U8]]:
        """All frames, with their decoded images."""
        decoder = encoders.Decoder()
        seen = [(frame, decoder.decode(frame.data)) for frame in self.frames]
        assert all(image is not None for _, image in seen)
        return [(frame, image) for frame, image in seen if image is not None]

    def in_order(self) -> bool:
        """Whether frames were output in capture order, each at most once."""
        times = [frame.captured for frame in self.frames]
        return times == sorted(set(times))
