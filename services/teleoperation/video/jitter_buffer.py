"""Encrypted packets to frames in their order: each is given out as soon as it and its predecessors are whole.

Packets of several links come in any order, some twice. One that lacks is waited for as long as such have come late
lately, then asked for again. Where that brings nothing, either, what follows is left out up to the next key frame.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import Key, Malformed, Report
from scan2sim.services.teleoperation.video import rtp_packets
from scan2sim.services.teleoperation.video.srtp_session import Opener

SHORTEST, FIRST, LONGEST = 0.015, 0.04, 0.15
"""Seconds that a packet is waited for before it is asked for again: at least, in the beginning, at most."""
FORGETS = 0.98
"""What is left after each frame of how late packets came: half after a second of 30 frames."""
AGAIN = 0.25
"""Seconds after which a key frame is wanted again: about the time there, to encode it, and back."""
ASKED, TRIPS = 2, 1.5
"""Times that a packet is asked for again; round trips (and `FIRST`, for both machines) that each asking is given."""
MENDABLE = 32
"""Packets of a camera that may lack at once: of more, a key frame tells sooner."""
HELD = 1024
"""Packets of a camera that wait for others, at most."""


class Frame(NamedTuple):
    """A frame of VP8.

    Attributes:
        captured: nanoseconds of the vehicle's monotonic clock.
        key: whether it is a key frame.
        width, height: pixels, of it or of the last key frame.
    """

    camera: int
    captured: int
    key: bool
    data: bytes
    width: int
    height: int


class Patience:
    """How long a packet is waited for: half longer than those that came late lately."""

    def __init__(self) -> None:
        self.seconds = FIRST

    def came(self, late: float) -> None:
        """A packet came so many seconds after one that was sent after it."""
        self.seconds = min(LONGEST, max(self.seconds, 1.5 * late))

    def pass_by(self) -> None:
        """A frame came as it should."""
        self.seconds = max(SHORTEST, self.seconds * FORGETS)


@dataclass(slots=True)
class _Lack:
    """A packet that hasn't come; since when a later one has; how often it was asked for again, and when last."""

    since: float
    times: int = 0
    asked: float = 0.0


class Assembly:
    """Frames of one source (SSRC), from its packets, each of which comes once; knows no encryption and no clock.

    A frame is given out if it follows the last one, or is a key frame.

    Attributes:
        frames, broken: that were given out, and that weren't, by their numbers.
        received: packets; mended: of these, such that came because they were asked for again.
        wants: whether it can't go on without a key frame, and none is coming.
    """

    def __init__(self, patience: Patience, trip: Callable[[], float]) -> None:
        """`trip`: seconds there and back, as far as is known."""
        self.frames = self.broken = self.received = self.mended = 0
        self.wants = False
        self._patience, self._trip = patience, trip
        self._began = 0.0
        self._lacks: dict[int, _Lack] = {}
        self._held: dict[int, rtp_packets.Packet] = {}
        self._keys: set[int] = set()
        self._next: int | None = None  # what follows the last frame
        self._coming: int | None = None  # where the frame begins that is to be next
        self._number = 0
        self._lowest = self._highest = 0  # sequences of all packets, which go on beyond 16 bits

    def add(self, packet: rtp_packets.Packet, now: float) -> Iterator[list[rtp_packets.Packet]]:
        """Take a packet; gives the frames that are whole by it."""
        sequence = self._unwrapped(packet.sequence, now)
        self.received += 1
        if (lack := self._lacks.pop(sequence, None)) is not None:
            self._came_late(lack, now)
        if self._next is not None and sequence < self._next:
            return
        self._hold(sequence, packet)
        while whole := self._whole():
            yield self._give_out(*whole)
        self._wait(now)

    def lacking(self, now: float) -> list[int]:
        """Packets, by their sequence, to be asked for again now."""
        asked = []
        for sequence, lack in self._lacks.items():
            due = lack.asked + self._mending() if lack.times else lack.since + self._patience.seconds
            if lack.times < ASKED and now > due:
                lack.times, lack.asked = lack.times + 1, now
                asked.append(sequence & 0xFFFF)
        return asked

    def _mending(self) -> float:
        """Seconds that a packet which was asked for is given."""
        return TRIPS * self._trip() + FIRST

    def _came_late(self, lack: _Lack, now: float) -> None:
        if lack.times and now > lack.asked + self._trip() / 2:
            self.mended += 1
        else:  # nobody can have heard yet that it lacks
            self._patience.came(now - lack.since)

    def _unwrapped(self, sequence: int, now: float) -> int:
        if self.received == 0:
            self._lowest = self._highest = sequence
            self._began = now
        near = self._highest + (sequence - self._highest + 0x8000 & 0xFFFF) - 0x8000
        if 0 < near - self._highest - 1 <= MENDABLE - len(self._lacks):
            self._lacks.update((one, _Lack(now)) for one in range(self._highest + 1, near))
        self._lowest, self._highest = min(self._lowest, near), max(self._highest, near)
        return near

    @property
    def counts(self) -> Counter[str]:
        """As numbers by name; `lost`: packets between the first and the last that didn't come at all."""
        lost = self._highest - self._lowest + 1 - self.received if self.received else 0
        return Counter(frames=self.frames, broken=self.broken, received=self.received, lost=lost, mended=self.mended)

    def _hold(self, sequence: int, packet: rtp_packets.Packet) -> None:
        self._held[sequence] = packet
        if packet.key:
            self._keys.add(sequence)
            if self.wants or self._coming is None:
                self.wants, self._coming = False, sequence
        if len(self._held) > HELD:
            self._drop(min(self._held))

    def _drop(self, sequence: int) -> None:
        del self._held[sequence]
        self._keys.discard(sequence)

    def _whole(self) -> tuple[int, list[rtp_packets.Packet]] | None:
        """The next frame that can be given out, and its sequence."""
        following = () if self._next is None else (self._next,)
        for sequence in (*following, *sorted(self._keys)):
            frame = self._frame_at(sequence)
            if frame:
                return sequence, frame
        return None

    def _frame_at(self, sequence: int) -> list[rtp_packets.Packet]:
        frame: list[rtp_packets.Packet] = []
        while packet := self._held.get(sequence + len(frame)):
            if packet.first != (not frame):
                return []
            frame.append(packet)
            if packet.last:
                return frame
        return []

    def _give_out(self, sequence: int, frame: list[rtp_packets.Packet]) -> list[rtp_packets.Packet]:
        """All up to the frame's end is done with."""
        number = frame[0].number
        if self.frames:
            self.broken += (number - self._number & 0x7FFF) - 1
        self.frames += 1
        self.wants, self._number = False, number
        self._next = self._coming = sequence + len(frame)
        for old in [one for one in self._held if one < self._next]:
            self._drop(old)
        for old in [one for one in self._lacks if one < self._next]:
            del self._lacks[old]
        self._patience.pass_by()
        return frame

    def _wait(self, now: float) -> None:
        """See which packet lacks, and whether it has been waited for long enough."""
        lacking = self._coming
        if lacking is None:  # there was no key frame yet
            self.wants = now > self._began + self._patience.seconds
            return
        while lacking in self._held:
            lacking += 1
        if lacking <= self._highest:  # else the frame's end isn't there yet
            lack = self._lacks.get(lacking)
            self.wants = lack is None or now > lack.since + self._patience.seconds + self._mending()


class _View:
    """A camera, as it comes: by one source, and from the next key of the encryption on by another."""

    def __init__(self, camera: int, trip: Callable[[], float]) -> None:
        self._camera, self._trip = camera, trip
        self._patience = Patience()
        self._source, self._past = -1, -1
        self._assemblies: dict[int, Assembly] = {}  # of the source, and of the one that is coming
        self._before: Counter[str] = Counter()  # counts of sources that are past
        self._told: Counter[str] = Counter()
        self._wanted = -AGAIN
        self._delays: list[float] = []
        self._size = (0, 0)
        self.links: Counter[str] = Counter()

    def add(self, packet: rtp_packets.Packet, now: float) -> Iterator[Frame]:
        """Take a packet; gives the frames that are whole by it."""
        source = packet.source
        if source == self._past:
            return
        if source not in self._assemblies:
            self._close(other for other in self._assemblies if other != self._source)
            self._assemblies[source] = Assembly(self._patience, self._trip)
        for parts in self._assemblies[source].add(packet, now):
            if source != self._source:
                self._close([self._source])
                self._past, self._source = self._source, source
            yield self._frame(parts)

    def _close(self, sources: Iterable[int]) -> None:
        for source in set(sources) & self._assemblies.keys():
            self._before.update(self._assemblies.pop(source).counts)

    def _frame(self, parts: list[rtp_packets.Packet]) -> Frame:
        data = b"".join([packet.data for packet in parts])
        first = parts[0]
        if first.key:
            self._size = rtp_packets.size(data)
        return Frame(self._camera, first.captured, first.key, data, *self._size)

    def wants(self, now: float) -> bool:
        """Whether a key frame is to be asked for now."""
        if now < self._wanted + AGAIN or not any(one.wants for one in self._assemblies.values()):
            return False
        self._wanted = now
        return True

    def lacking(self, now: float) -> Iterator[tuple[int, list[int]]]:
        """Sources, and their packets that are to be asked for again now."""
        for source, assembly in self._assemblies.items():
            if asked := assembly.lacking(now):
                yield source, asked

    @property
    def counts(self) -> Counter[str]:
        """Since the beginning."""
        total = self._before.copy()
        for assembly in self._assemblies.values():
            total.update(assembly.counts)
        return total

    def delayed(self, milliseconds: float) -> None:
        """A frame took so long."""
        self._delays.append(milliseconds)

    def report(self, seconds: float) -> Report:
        """Of so many seconds, those since the last report."""
        total, told = self.counts, self._told
        delay = round(statistics.median(self._delays), 1) if self._delays else None
        links = {name: amount / seconds for name, amount in self.links.items()}
        self._told = total
        self._delays.clear()
        self.links.clear()
        received, lost, mended = (total[what] - told[what] for what in ("received", "lost", "mended"))
        return Report(self._camera, max(0, received - mended), max(0, lost + mended), delay, links)


class Watcher:
    """What a vehicle's cameras send, on the station's side. May be fed by several threads.

    Attributes:
        counts: packets that were dropped, by why: see `srtp.Opener`.
    """

    def __init__(
        self,
        frame: Callable[[Frame], None],
        want: Callable[[int], None],
        age: Callable[[int], float],
        ask: Callable[[int, Sequence[int]], None],
        trip: Callable[[], float],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Of what is called in the thread that feeds it, and returns at once.

        Args:
            frame: is given each frame.
            want: is given the number of a camera of which a key frame is wanted.
            age: milliseconds since a moment of the vehicle's monotonic clock, in nanoseconds.
            ask: is given a source, and its packets that are to be sent again.
            trip: seconds there and back, as far as is known.
            clock: seconds.
        """
        self._frame, self._want, self._age, self._clock = frame, want, age, clock
        self._ask, self._trip = ask, trip
        self._opener = Opener()
        self._views: dict[int, _View] = {}
        self._reported = clock()
        self._lock = threading.Lock()

    @property
    def counts(self) -> Counter[str]:
        """Packets that were dropped, by why."""
        return self._opener.counts

    def frames(self) -> dict[int, Counter[str]]:
        """By camera: `frames` that were given out, `broken` ones that weren't, packets `received`, `mended`, `lost`."""
        with self._lock:
            return {camera: view.counts for camera, view in self._views.items()}

    def learn(self, key: Key) -> None:
        """Take a key of the vehicle's."""
        with self._lock:
            self._opener.learn(key)

    def feed(self, packet: bytes, link: str) -> None:
        """Take a packet that came by a link."""
        now = self._clock()
        with self._lock:
            plain = self._opener.open(packet, now)
            known = self._views.get(packet[11]) if len(packet) > 11 else None
            if known:
                known.links[link] += len(packet)
            if plain is not None:
                self._take(plain, now)

    def _take(self, plain: bytes, now: float) -> None:
        try:
            packet = rtp_packets.parse(plain)
            camera = packet.source & 0xFF
            view = self._views.get(camera) or self._views.setdefault(camera, _View(camera, self._trip))
            for frame in view.add(packet, now):
                view.delayed(self._age(frame.captured))
                self._frame(frame)
        except Malformed:
            self._opener.counts["malformed"] += 1
            return
        for source, asked in view.lacking(now):
            self._ask(source, asked)
        if view.wants(now):
            self._want(camera)

    def reports(self) -> list[Report]:
        """How all cameras came since the last call; to be called once a second or so."""
        with self._lock:
            now = self._clock()
            seconds, self._reported = max(now - self._reported, 1e-3), now
            return [view.report(seconds) for view in self._views.values()]
