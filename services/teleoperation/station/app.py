"""The station: what comes from the vehicle that it is joined with, and what its driver asks of it.

Listens to vehicles, is a party of the gateway's, and hands pictures and facts to whoever watches (`cockpit`). What the
driver asks goes to the vehicle fifty times a second, as long as the driver goes on asking (`wheel`).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from scan2sim.services.teleoperation.control.driver_session import Wheel
from scan2sim.services.teleoperation.control.messages import (
    Key,
    Kind,
    Lacking,
    Malformed,
    Message,
    Report,
    Streams,
    Telemetry,
    Wanted,
)
from scan2sim.services.teleoperation.gateway.client import Membership
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.gateway.protocol import (
    Address,
    Ask,
    Driving,
    Hello,
    Join,
    Refused,
    Release,
    Status,
)
from scan2sim.services.teleoperation.transport.link_stats import Rates
from scan2sim.services.teleoperation.transport.multipath import Bundle
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, Watcher

RATE = 50.0
"""Commands a second."""
REPORTS = 1.0
"""Seconds between two reports of how the video comes."""
TRIP = 0.1
"""Seconds to the vehicle and back, while nothing is known of it."""


class Joined:
    """A vehicle that the station is joined with: what it says, its video, its links.

    Attributes:
        telemetry: the last, sent at `sent` (ns of the vehicle's monotonic clock).
        streams: the vehicle's cameras; `reports`: how they came over the last second.
        malformed: messages that can't be understood, so far.
    """

    def __init__(self, pair: int, vehicle: Peer, listener: Listener, show: Callable[[Frame], None]) -> None:
        """`show` is handed frames, in the receiving thread."""
        self.pair, self.vehicle = pair, vehicle
        self.telemetry: Telemetry | None = None
        self.sent = 0
        self.streams: Streams = Streams(())
        self.malformed = 0
        self.reports: tuple[Report, ...] = ()
        self.rates = Rates()
        self.watcher = Watcher(frame=show, want=self.want, age=self.age, ask=self._ask, trip=self._trip)
        self._listener = listener
        self.bundle: Bundle = listener.expect(vehicle, received=self._received, media=self.watcher.feed)

    def age(self, captured: int) -> float:
        """Milliseconds since a moment of the vehicle's monotonic clock (ns)."""
        return self.bundle.clocks.age_ms(captured)

    def telemetry_age_ms(self) -> float | None:
        """Milliseconds since the vehicle sent its telemetry, also where that lay in a queue; None: unknown."""
        age = self.age(self.sent)
        return None if self.telemetry is None or math.isinf(age) else age

    def want(self, camera: int) -> None:
        """Ask for a key frame of a camera."""
        self.bundle.send(Kind.WANTED, Wanted(camera).pack())

    def _ask(self, source: int, sequences: Sequence[int]) -> None:
        self.bundle.send(Kind.LACKING, Lacking(source, tuple(sequences)).pack())

    def _trip(self) -> float:
        """Seconds to the vehicle and back."""
        found = self.bundle.round_trip
        return TRIP if math.isnan(found) else found

    def report(self) -> None:
        """Tell how the video comes."""
        self.reports = tuple(self.watcher.reports())
        for one in self.reports:
            self.bundle.send(Kind.REPORT, one.pack())

    def _received(self, message: Message) -> None:
        try:
            match message.kind:
                case Kind.TELEMETRY:
                    self.telemetry, self.sent = Telemetry.unpack(message.body), message.sent
                case Kind.KEY:
                    self.watcher.learn(Key.unpack(message.body))
                case Kind.STREAMS:
                    self.streams = Streams.unpack(message.body)
                case _:
                    self.malformed += 1
        except Malformed:
            self.malformed += 1

    def hindrance(self) -> str:
        """Why nobody may drive; nothing: one may."""
        clocks = self.bundle.clocks
        if not any(link.up for link in self.bundle.links):
            return "no link to the vehicle is up"
        if not clocks.known:
            return "the clocks haven't been compared yet"
        if clocks.wall_wrong:
            return f"the vehicle's clock is {clocks.wall_apart_s:+.1f} s off this one's: tie both to NTP"
        return ""

    def close(self) -> None:
        """Let go of the vehicle."""
        self._listener.forget(self.vehicle)
        self.bundle.close()


class Station:
    """A party of the gateway's (see `membership.Party`); `wheel` is its driver's."""

    def __init__(
        self,
        identity: Identity,
        listener: Listener,
        reached: Sequence[Address],
        show: Callable[[Frame], None],
    ) -> None:
        """Begin; nothing happens before the gateway joins it with a vehicle.

        Args:
            identity: its own.
            listener: where vehicles dial.
            reached: the listener's addresses, as vehicles see them.
            show: is handed frames.
        """
        self.identity, self.wheel = identity, Wheel()
        self._listener, self._reached, self._show = listener, tuple(reached), show
        self._lock = threading.Lock()
        self._joined: Joined | None = None
        self._why = "no vehicle is joined"
        self._ended = threading.Event()
        self._threads = [
            threading.Thread(target=self._drive, name="commands", daemon=True),
            threading.Thread(target=self._report, name="reports of the video", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    # as a party of the gateway's

    def hello(self) -> Hello:
        """See `Party`."""
        joined = self.joined()
        driving = None if joined is None else Driving(pair=joined.pair, other=joined.vehicle.name)
        return Hello(listening=self._reached, driving=driving)

    def status(self) -> Status:
        """See `Party`."""
        joined = self.joined()
        if joined is None:
            return Status(told=self._why)
        delays = [report.delay for report in joined.reports if report.delay is not None]
        return Status(
            pair=joined.pair,
            links=joined.rates.links(joined.bundle),
            driving=self.wheel.held_by() is not None,
            told=joined.hindrance()[:200],
            age=max(delays) if delays else None,
        )

    def obey(self, order: Join | Release | Refused) -> None:
        """See `Party`."""
        if isinstance(order, Refused):
            self._why = order.cause
            return
        wanted = None
        if isinstance(order, Join):
            wanted = Peer(Role.VEHICLE, order.other.name, order.other.fingerprint)
        before = self.joined()
        if before is not None and isinstance(order, Join) and (before.pair, before.vehicle) == (order.pair, wanted):
            return
        with self._lock:
            self._joined = None
        if before is not None:
            before.close()
            self.wheel.leave(self.wheel.held_by() or "", "the vehicle was released")
        if isinstance(order, Join) and wanted is not None:
            joined = Joined(order.pair, wanted, self._listener, self._show)
            with self._lock:
                self._joined = joined
        elif isinstance(order, Release):
            self._why = order.why

    # for who watches and drives

    def joined(self) -> Joined | None:
        """The vehicle that it is joined with."""
        with self._lock:
            return self._joined

    def facts(self) -> dict[str, Any]:
        """What a driver is shown."""
        joined = self.joined()
        told: dict[str, Any] = {
            "station": self.identity.me.name,
            "driver": self.wheel.held_by(),
            "left": self.wheel.told,
        }
        if joined is None:
            return told | {"vehicle": None, "why": self._why}
        clocks = joined.bundle.clocks
        return told | {
            "vehicle": joined.vehicle.name,
            "why": joined.hindrance(),
            "telemetry": None if joined.telemetry is None else asdict(joined.telemetry),
            "telemetry_age_ms": joined.telemetry_age_ms(),
            "cameras": [asdict(one) for one in joined.streams.cameras],
            "links": [one.model_dump() for one in joined.rates.links(joined.bundle)],
            "clocks": {"uncertainty_ms": clocks.uncertainty_ms, "wall_apart_s": clocks.wall_apart_s}
            if clocks.known
            else None,
        }

    def alive(self) -> bool:
        """Whether its threads live."""
        return all(thread.is_alive() for thread in self._threads)

    def close(self) -> None:
        """End; the vehicle stops."""
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        self.obey(Release())

    def _drive(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            joined, command = self.joined(), self.wheel.command(time.monotonic())
            if joined is not None and command is not None and not joined.hindrance():
                joined.bundle.send(Kind.COMMAND, command.pack())
            due = max(due + 1 / RATE, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _report(self) -> None:
        while not self._ended.wait(REPORTS):
            if (joined := self.joined()) is not None:
                joined.report()


def ask(membership: Membership, what: str, vehicle: str) -> bool:
    """Ask the gateway for a vehicle, or to be rid of it; False: the gateway isn't reached."""
    return membership.ask(Ask(what="join" if what == "join" else "release", vehicle=vehicle))
