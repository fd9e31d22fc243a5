"""Video as tests send it: from a camera's coder over made-up links to a watcher, on a clock of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import cv2
import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.cameras import Picture, pattern
from scan2sim.services.teleoperation.video.capture import Coder
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, Watcher
from scan2sim.services.teleoperation.video.rate_control import Plan
from scan2sim.services.teleoperation.video.srtp_session import Keys

STEP = 33_333_333
"""Nanoseconds between pictures."""
TRIP = 0.09
"""Seconds there and back."""
Link = Callable[[list[bytes]], Iterable[bytes]]
"""What comes of packets that are sent."""


def scenery(width: int = 320, height: int = 240) -> Iterator[Picture]:
    """Pictures 33 ms apart."""
    still = cv2.GaussianBlur(pattern.bars(width, height), (0, 0), 1.5).astype(np.uint8)
    for i in range(100_000):
        yield Picture(pattern.at(still, i / 30), i * STEP)


def psnr(a: U8, b: U8) -> float:
    """Peak signal to noise, dB."""
    return float(cv2.PSNR(a, b))


class Drive:
    """A camera's pictures, sent and watched; the station wants key frames as it does in earnest.

    Attributes:
        frames: that were given out; `pictures`: that were sent, by their time.
        wanted: times at which key frames were; `asked`: times at which packets were asked for again.
    """

    def __init__(self, every: float = 1e9, plan: Plan | None = None, mends: bool = False) -> None:
        """`mends`: packets that are asked for are sent again."""
        self.now = 0.0
        self.keys = Keys(self.now, every)
        self.coder = Coder(3, self.keys, encoders.find("pyav"))
        self.plan = plan or Plan(bitrate=800_000)
        self.frames: list[Frame] = []
        self.wanted: list[float] = []
        self.pictures: dict[int, U8] = {}
        self.watcher = Watcher(
            self.frames.append,
            self._want,
            lambda sent: self.now * 1e3 - sent / 1e6,
            self._ask,
            lambda: TRIP,
            lambda: self.now,
        )
        self.asked: list[float] = []
        self._mends, self._again = mends, list[tuple[float, list[bytes]]]()

    def _want(self, camera: int) -> None:
        assert camera == 3
        self.wanted.append(self.now)
        self.coder.want_key()

    def _ask(self, source: int, sequences: Sequence[int]) -> None:
        self.asked.append(self.now)
        if self._mends:
            self._again.append((self.now + TRIP, self.coder.again(source, sequences)))

    def send(self, pictures: Iterable[Picture], link: Link = lambda packets: packets, name: str = "lte") -> None:
        """All pictures, one after the other."""
        for picture in pictures:
            self.now = picture.captured / 1e9
            for key in self.keys.told(self.now):
                self.watcher.learn(key)
            self.pictures[picture.captured] = picture.image
            packets = self.coder.code(picture, self.plan, self.now)
            while self._again and self._again[0][0] <= self.now:
                packets = [*self._again.pop(0)[1], *packets]
            for packet in link(packets):
                self.watcher.feed(packet, name)

    def decoded(self) -> list[tuple[Frame, U8]]:
        """All frames, with what is seen in them."""
        decoder = encoders.Decoder()
        seen = [(frame, decoder.decode(frame.data)) for frame in self.frames]
        assert all(image is not None for _, image in seen)
        return [(frame, image) for frame, image in seen if image is not None]

    def in_order(self) -> bool:
        """Whether the frames came in the order of their pictures, each at most once."""
        times = [frame.captured for frame in self.frames]
        return times == sorted(set(times))
