"""Jitter buffer: reorders encrypted packets into frames; a frame is output once it and its predecessors are complete.

Packets arrive over several links in any order, some twice. A missing packet is waited for as long as recent reordering
delays suggest, then NACKed. If it isn't retransmitted in time, later frames are dropped up to the next key frame.
"""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import CongestionReport, Malformed, VideoKey, VideoReport
from scan2sim.services.teleoperation.video import rtp_packets
from scan2sim.services.teleoperation.video.congestion import CongestionDetector
from scan2sim.services.teleoperation.video.srtp_session import PacketDecryptor

REORDER_TIMEOUT_MIN_S, REORDER_TIMEOUT_INITIAL_S, REORDER_TIMEOUT_MAX_S = 0.015, 0.04, 0.15
"""Time until a missing packet is NACKed: minimum, initial, maximum; it adapts to recent reordering."""
REORDER_TIMEOUT_DECAY = 0.98
"""Decay of that timeout with each frame: half after a second of 30 frames/s."""
KEY_FRAME_REQUEST_INTERVAL_S = 0.25
"""Interval between key frame requests: about a round trip and the time to encode."""
NACKS_MAX, NACK_TIMEOUT_ROUND_TRIPS = 2, 1.5
"""NACKs sent for a packet; timeout of a NACK in round trips, plus `REORDER_TIMEOUT_INITIAL_S` for processing."""
MISSING_PACKETS_MAX = 32
"""Packets of a camera that may be missing at once; with more, a key frame is faster."""
BUFFER_MAX_PACKETS = 1024
"""Maximum number of packets of a camera in the buffer."""


class Frame(NamedTuple):
    """An encoded frame (VP8).

    Attributes:
        captured: capture time, nanoseconds of the vehicle's monotonic clock.
        key: whether it is a key frame.
        width, height: pixels, of this frame or of the last key frame.
    """

    camera: int
    captured: int
    key: bool
    data: bytes
    width: int
    height: int


class ReorderTimeout:
    """Adaptive timeout until a missing packet is NACKed: 1.5 times the recent maximum of reordering delays."""

    def __init__(self) -> None:
        self.seconds = REORDER_TIMEOUT_INITIAL_S

    def observe(self, late: float) -> None:
        """Observe a packet that arrived this many seconds after a later one."""
        self.seconds = min(REORDER_TIMEOUT_MAX_S, max(self.seconds, 1.5 * late))

    def decay(self) -> None:
        """Shorten the timeout after each frame."""
        self.seconds = max(REORDER_TIMEOUT_MIN_S, self.seconds * REORDER_TIMEOUT_DECAY)


@dataclass(slots=True)
class _MissingPacket:
    """A missing packet: since when a later one is there; number of NACKs sent, and time of the last."""

    since: float
    nacks: int = 0
    last_nack: float = 0.0


class FrameAssembler:
    """Assembles the frames of one source (SSRC) from its packets, without duplicates; has no encryption or clock.

    A frame is output if it follows the last one, or is a key frame.

    Attributes:
        frames, broken: number of frames output, and not output, by their picture numbers.
        received: packets; retransmitted: those of them that arrived after a NACK.
        needs_key_frame: whether a key frame is needed to continue, and none is arriving.
    """

    def __init__(self, reorder_timeout: ReorderTimeout, round_trip: Callable[[], float]) -> None:
        """`round_trip` returns the round-trip time, seconds."""
        self.frames = self.broken = self.received = self.retransmitted = 0
        self.needs_key_frame = False
        self._reorder_timeout, self._round_trip = reorder_timeout, round_trip
        self._started = 0.0
        self._missing: dict[int, _MissingPacket] = {}
        self._buffer: dict[int, rtp_packets.Packet] = {}
        self._key_frames: set[int] = set()
        self._next: int | None = None  # first packet after the last output frame
        self._next_start: int | None = None  # first packet of the frame to be output next
        self._last_number = 0
        self._lowest = self._highest = 0  # sequence numbers of all packets, unwrapped beyond 16 bits

    def add(self, packet: rtp_packets.Packet, now: float) -> Iterator[list[rtp_packets.Packet]]:
        """Add a packet; yields the frames that it completes."""
        sequence = self._unwrap(packet.sequence, now)
        self.received += 1
        if (missing := self._missing.pop(sequence, None)) is not None:
            self._record_late(missing, now)
        if self._next is not None and sequence < self._next:
            return
        self._insert(sequence, packet)
        while complete := self._complete_frame():
            yield self._output(*complete)
        self._check_missing(now)

    def due_nacks(self, now: float) -> list[int]:
        """Sequence numbers of the packets to be NACKed now."""
        sequences = []
        for sequence, missing in self._missing.items():
            due = (
                missing.last_nack + self._nack_timeout()
                if missing.nacks
                else missing.since + self._reorder_timeout.seconds
            )
            if missing.nacks < NACKS_MAX and now > due:
                missing.nacks, missing.last_nack = missing.nacks + 1, now
                sequences.append(sequence & 0xFFFF)
        return sequences

    def _nack_timeout(self) -> float:
        """Seconds until a NACK times out."""
        return NACK_TIMEOUT_ROUND_TRIPS * self._round_trip() + REORDER_TIMEOUT_INITIAL_S

    def _record_late(self, missing: _MissingPacket, now: float) -> None:
        if missing.nacks and now > missing.last_nack + self._round_trip() / 2:
            self.retransmitted += 1
        else:  # too early to be the answer to a NACK: the packet was reordered
            self._reorder_timeout.observe(now - missing.since)

    def _unwrap(self, sequence: int, now: float) -> int:
        if self.received == 0:
            self._lowest = self._highest = sequence
            self._started = now
        unwrapped = self._highest + (sequence - self._highest + 0x8000 & 0xFFFF) - 0x8000
        if 0 < unwrapped - self._highest - 1 <= MISSING_PACKETS_MAX - len(self._missing):
            self._missing.update((one, _MissingPacket(now)) for one in range(self._highest + 1, unwrapped))
        self._lowest, self._highest = min(self._lowest, unwrapped), max(self._highest, unwrapped)
        return unwrapped

    @property
    def counts(self) -> Counter[str]:
        """Counts by name; `lost`: packets between the first and the last that were never received."""
        lost = self._highest - self._lowest + 1 - self.received if self.received else 0
        return Counter(
            frames=self.frames, broken=self.broken, received=self.received, lost=lost, retransmitted=self.retransmitted
        )

    def _insert(self, sequence: int, packet: rtp_packets.Packet) -> None:
        self._buffer[sequence] = packet
        if packet.key:
            self._key_frames.add(sequence)
            if self.needs_key_frame or self._next_start is None:
                self.needs_key_frame, self._next_start = False, sequence
        if len(self._buffer) > BUFFER_MAX_PACKETS:
            self._drop(min(self._buffer))

    def _drop(self, sequence: int) -> None:
        del self._buffer[sequence]
        self._key_frames.discard(sequence)

    def _complete_frame(self) -> tuple[int, list[rtp_packets.Packet]] | None:
        """The next complete frame that can be output, and its first sequence number."""
        following = () if self._next is None else (self._next,)
        for sequence in (*following, *sorted(self._key_frames)):
            frame = self._frame_at(sequence)
            if frame:
                return sequence, frame
        return None

    def _frame_at(self, sequence: int) -> list[rtp_packets.Packet]:
        frame: list[rtp_packets.Packet] = []
        while packet := self._buffer.get(sequence + len(frame)):
            if packet.first != (not frame):
                return []
            frame.append(packet)
            if packet.last:
                return frame
        return []

    def _output(self, sequence: int, frame: list[rtp_packets.Packet]) -> list[rtp_packets.Packet]:
        """Output a frame, and discard all packets up to its end."""
        number = frame[0].number
        if self.frames:
            self.broken += (number - self._last_number & 0x7FFF) - 1
        self.frames += 1
        self.needs_key_frame, self._last_number = False, number
        self._next = self._next_start = sequence + len(frame)
        for old in [one for one in self._buffer if one < self._next]:
            self._drop(old)
        for old in [one for one in self._missing if one < self._next]:
            del self._missing[old]
        self._reorder_timeout.decay()
        return frame

    def _check_missing(self, now: float) -> None:
        """Check whether a packet is missing for too long, so that a key frame is needed."""
        first_missing = self._next_start
        if first_missing is None:  # there was no key frame yet, nor part of one
            self.needs_key_frame = now > self._started + self._reorder_timeout.seconds
            return
        while first_missing in self._buffer:
            first_missing += 1
        if first_missing <= self._highest:  # else the end of the frame has not been sent yet
            missing = self._missing.get(first_missing)
            self.needs_key_frame = (
                missing is None or now > missing.since + self._reorder_timeout.seconds + self._nack_timeout()
            )


class _CameraReceiver:
    """Receives the video of one camera, from a source (SSRC) that changes with each encryption key."""

    def __init__(self, camera: int, round_trip: Callable[[], float]) -> None:
        self._camera, self._round_trip = camera, round_trip
        self._reorder_timeout = ReorderTimeout()
        self._source, self._previous_source = -1, -1
        self._assemblers: dict[int, FrameAssembler] = {}  # of the current source, and of the next one
        self._previous_counts: Counter[str] = Counter()  # counts of previous sources
        self._reported_counts: Counter[str] = Counter()
        self._last_request = -KEY_FRAME_REQUEST_INTERVAL_S
        self._delays: list[float] = []
        self._size = (0, 0)
        self.links: Counter[str] = Counter()

    def add(self, packet: rtp_packets.Packet, now: float) -> Iterator[Frame]:
        """Add a packet; yields the frames that it completes."""
        source = packet.source
        if source == self._previous_source:
            return
        if source not in self._assemblers:
            self._close(other for other in self._assemblers if other != self._source)
            self._assemblers[source] = FrameAssembler(self._reorder_timeout, self._round_trip)
        for parts in self._assemblers[source].add(packet, now):
            if source != self._source:
                self._close([self._source])
                self._previous_source, self._source = self._source, source
            yield self._frame(parts)

    def _close(self, sources: Iterable[int]) -> None:
        for source in set(sources) & self._assemblers.keys():
            self._previous_counts.update(self._assemblers.pop(source).counts)

    def _frame(self, parts: list[rtp_packets.Packet]) -> Frame:
        data = b"".join([packet.data for packet in parts])
        first = parts[0]
        if first.key:
            self._size = rtp_packets.key_frame_size(data)
        return Frame(self._camera, first.captured, first.key, data, *self._size)

    def key_frame_due(self, now: float) -> bool:
        """Whether to request a key frame now."""
        if now < self._last_request + KEY_FRAME_REQUEST_INTERVAL_S or not any(
            one.needs_key_frame for one in self._assemblers.values()
        ):
            return False
        self._last_request = now
        return True

    def due_nacks(self, now: float) -> Iterator[tuple[int, list[int]]]:
        """Sources, and their packets to be NACKed now."""
        for source, assembler in self._assemblers.items():
            if sequences := assembler.due_nacks(now):
                yield source, sequences

    @property
    def counts(self) -> Counter[str]:
        """Counts since the beginning."""
        total = self._previous_counts.copy()
        for assembler in self._assemblers.values():
            total.update(assembler.counts)
        return total

    def add_delay(self, milliseconds: float) -> None:
        """Add the delay of a frame."""
        self._delays.append(milliseconds)

    def report(self, seconds: float) -> VideoReport:
        """Statistics since the last report, `seconds` ago."""
        total, reported = self.counts, self._reported_counts
        delay = round(statistics.median(self._delays), 1) if self._delays else None
        links = {name: amount / seconds for name, amount in self.links.items()}
        self._reported_counts = total
        self._delays.clear()
        self.links.clear()
        received, lost, retransmitted = (total[what] - reported[what] for what in ("received", "lost", "retransmitted"))
        return VideoReport(self._camera, max(0, received - retransmitted), max(0, lost + retransmitted), delay, links)


class VideoReceiver:
    """Receives the video of a vehicle's cameras, on the station's side; thread-safe.

    Attributes:
        counts: number of dropped packets, by reason; see `srtp_session.PacketDecryptor`.
    """

    def __init__(
        self,
        frame: Callable[[Frame], None],
        request_key_frame: Callable[[int], None],
        age: Callable[[int], float],
        send_nack: Callable[[int, Sequence[int]], None],
        round_trip: Callable[[], float],
        clock: Callable[[], float] = time.monotonic,
        congested: Callable[[CongestionReport], None] = lambda report: None,
    ) -> None:
        """Callbacks are called in the thread that calls `feed`, and must return at once.

        Args:
            frame: called with each frame.
            request_key_frame: called with the number of a camera from which a key frame is needed.
            age: returns the age of a time of the vehicle's monotonic clock (ns), milliseconds.
            send_nack: called with a source, and its packets to retransmit.
            round_trip: returns the round-trip time, seconds.
            clock: returns the current time, seconds.
            congested: called when a queue grows on the links.
        """
        self._frame, self._request_key_frame, self._age, self._clock = frame, request_key_frame, age, clock
        self._send_nack, self._round_trip, self._congested = send_nack, round_trip, congested
        self._congestion_detector = CongestionDetector()
        self._decryptor = PacketDecryptor()
        self._cameras: dict[int, _CameraReceiver] = {}
        self._last_report = clock()
        self._lock = threading.Lock()

    @property
    def counts(self) -> Counter[str]:
        """Number of dropped packets, by reason."""
        return self._decryptor.counts

    def frames(self) -> dict[int, Counter[str]]:
        """Counts by camera: `frames` output, `broken` ones not output, packets `received`, `retransmitted`, `lost`."""
        with self._lock:
            return {camera: camera_receiver.counts for camera, camera_receiver in self._cameras.items()}

    def add_key(self, key: VideoKey) -> None:
        """Add a key of the vehicle's video encryption."""
        with self._lock:
            self._decryptor.add_key(key)

    def feed(self, packet: bytes, link: str) -> None:
        """Process a packet received over a link."""
        now = self._clock()
        with self._lock:
            plain = self._decryptor.decrypt(packet, now)
            known = self._cameras.get(packet[11]) if len(packet) > 11 else None
            if known:
                known.links[link] += len(packet)
            if plain is not None:
                self._process(plain, now)

    def _process(self, plain: bytes, now: float) -> None:
        try:
            packet = rtp_packets.parse(plain)
            camera = packet.source & 0xFF
            camera_receiver = self._cameras.get(camera) or self._cameras.setdefault(
                camera, _CameraReceiver(camera, self._round_trip)
            )
            for frame in camera_receiver.add(packet, now):
                camera_receiver.add_delay(self._age(frame.captured))
                self._frame(frame)
        except Malformed:
            self._decryptor.counts["malformed"] += 1
            return
        if math.isfinite(age := self._age(packet.sent)):
            report = self._congestion_detector.add(now, age, len(plain), camera)
            if report is not None:
                self._congested(report)
        for source, sequences in camera_receiver.due_nacks(now):
            self._send_nack(source, sequences)
        if camera_receiver.key_frame_due(now):
            self._request_key_frame(camera)

    def reports(self) -> list[VideoReport]:
        """Statistics of all cameras since the last call; to be called about once a second."""
        with self._lock:
            now = self._clock()
            seconds, self._last_report = max(now - self._last_report, 1e-3), now
            return [camera_receiver.report(seconds) for camera_receiver in self._cameras.values()]
