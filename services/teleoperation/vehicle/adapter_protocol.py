"""The vehicle's interface: what a car unit says to a vehicle's translator, and its answers (docs/teleoperation.md).

One UDP packet an order, one an answer to it. An order says what the vehicle is to do now, and how old the driver's
command is; an answer how the vehicle is. Both ends judge each other by `safety`: a translator that doesn't hear a good
order for the limit stops the vehicle by itself, and leaves that stop only when the car unit names it and agrees, which
it does after the driver has confirmed.

How old an order is, a translator knows from its own clock alone: each answer carries a stamp of it, each order the
stamp of the last answer and for how long the car unit has had it. So a packet that lay in a queue, or was recorded, is
old. Numbers are little-endian; where a key is set, 16 bytes of HMAC-SHA-256 over all before them end each packet.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import struct
from dataclasses import dataclass, replace

from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Malformed
from scan2sim.services.teleoperation.control.safety import LIMIT_MS, MS, Safety

PORT = 7447
"""Where a translator listens, unless it is told otherwise."""
PERIOD_MS = 10.0
"""A translator looks at what it has heard, and tells the vehicle, so often."""
LARGEST = 1400
"""Bytes of a packet."""
TAG = 16
"""Bytes of a packet's HMAC."""
_ORDER = struct.Struct("<2sIIqIf")
_ANSWER = struct.Struct("<2sqIBfBddfb")
_IS_ORDER, _IS_ANSWER = b"O1", b"A1"
_STANDING = 1
_PLACED, _TURNED = 1, 2


@dataclass(frozen=True)
class Order:
    """What the vehicle is to do.

    Attributes:
        session: of the car unit, another each time that it starts.
        number: counts its orders.
        stamp: of the last answer; 0: there was none.
        held: microseconds since that came.
        age: milliseconds of the driver's command; 0 where the car unit itself has the vehicle stand.
        command: controls; the translator's stop that is known; whether it may be left.
    """

    session: int
    number: int
    stamp: int
    held: int
    age: float
    command: Command

    def pack(self, key: bytes = b"") -> bytes:
        """As a packet."""
        head = _ORDER.pack(_IS_ORDER, self.session, self.number, self.stamp, min(self.held, 2**32 - 1), self.age)
        return _sealed(head + self.command.pack(), key)

    @staticmethod
    def unpack(packet: bytes, key: bytes = b"") -> Order:
        """Of a packet.

        Raises:
            Malformed: it is none, or of who doesn't have the key.
        """
        data = _opened(packet, key)
        try:
            kind, session, number, stamp, held, age = _ORDER.unpack_from(data)
        except struct.error as error:
            raise Malformed(str(error)) from None
        if kind != _IS_ORDER or not 0 <= age < 1e9:
            raise Malformed("no order")
        return Order(session, number, stamp, held, age, Command.unpack(data[_ORDER.size :]))


@dataclass(frozen=True)
class Answer:
    """How the vehicle is.

    Attributes:
        stamp: of the translator's clock.
        stop: number of its last stop; standing: whether it stands for that still; reason: why.
        vehicle: what it tells of itself.
    """

    stamp: int
    stop: int
    standing: bool
    reason: str
    vehicle: VehicleState

    def pack(self, key: bytes = b"") -> bytes:
        """As a packet; what doesn't fit of the faults is left out."""
        v = self.vehicle
        known = _PLACED * (v.position is not None) | _TURNED * (v.heading is not None)
        x, y = v.position or (0.0, 0.0)
        head = _ANSWER.pack(
            _IS_ANSWER, self.stamp, self.stop, _STANDING * self.standing, v.speed, known, x, y, v.heading or 0.0, v.gear
        )
        lines = "\n".join(text.replace("\n", " ") for text in (self.reason, *v.faults)).encode()
        return _sealed((head + lines)[: LARGEST - TAG], key)

    @staticmethod
    def unpack(packet: bytes, key: bytes = b"") -> Answer:
        """Of a packet.

        Raises:
            Malformed: it is none, or of who doesn't have the key.
        """
        data = _opened(packet, key)
        try:
            kind, stamp, stop, flags, speed, known, x, y, heading, gear = _ANSWER.unpack_from(data)
            way = Gear(gear)
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None
        if kind != _IS_ANSWER or not all(
            abs(number) < 1e9 for number in (speed, x, y, heading)
        ):  # nor what is no number
            raise Malformed("no answer")
        reason, *faults = data[_ANSWER.size :].decode(errors="replace").split("\n")
        position = (x, y) if known & _PLACED else None
        vehicle = VehicleState(speed, position, heading if known & _TURNED else None, way, tuple(faults))
        return Answer(stamp, stop, bool(flags & _STANDING), reason, vehicle)


class TranslatorEnd:
    """A translator's end: which orders are obeyed, and what the vehicle does without; no thread, no network.

    A car unit is listened to until it is silent for the limit; then another may take its place.

    Attributes:
        safety: the translator's own.
    """

    def __init__(self, limit_ms: float = LIMIT_MS) -> None:
        # stamps and stops of an earlier translator mean nothing to this one
        self.safety = Safety(limit_ms, first_stop=secrets.randbits(30))
        self._base = secrets.randbits(61)
        self._session: int | None = None
        self._heard = 0

    def hear(self, order: Order, now: int) -> bool:
        """Take an order, which came now (ns), and say whether it was good."""
        silent = self._session is None or now - self._heard > self.safety.limit_ms * MS
        if silent and order.session != self._session:
            self._session = order.session
            self.safety.begin(order.session, "a car unit has begun")
        if order.session == self._session:
            self._heard = now
        sent = order.stamp - self._base + order.held * 1000  # at the earliest
        made = sent - round(order.age * MS)
        return self.safety.hear(order.session, order.number, order.command, made, now)

    def check(self, now: int) -> Controls:
        """What the vehicle is to do now."""
        return self.safety.check(now)

    def answer(self, vehicle: VehicleState, now: int) -> Answer:
        """What to answer to an order."""
        return Answer(self._base + now, self.safety.stop, self.safety.standing, self.safety.reason, vehicle)


class CarEnd:
    """A car unit's end: makes orders, and knows how its translator is; no thread, no network.

    Attributes:
        answer: the last; None: there was none.
        stopped: why the translator stopped, if it did since that was last asked (`take_stop`).
    """

    def __init__(self, limit_ms: float = LIMIT_MS) -> None:
        self.answer: Answer | None = None
        self._limit_ms = limit_ms
        self._session, self._number = secrets.randbits(32), 0
        self._heard, self._stop = 0, 0

    def hear(self, answer: Answer, now: int) -> str | None:
        """Take an answer, which came now (ns); a reason to stop, where the translator has stopped anew."""
        if self.answer is not None and answer.stamp < self.answer.stamp and not self.silent(now):
            return None  # one that was overtaken; after silence, another translator may have begun
        stopped = answer.standing and answer.stop != self._stop
        self.answer, self._heard, self._stop = answer, now, answer.stop
        return f"the translator stopped: {answer.reason}" if stopped else None

    def silent(self, now: int) -> bool:
        """Whether no answer has come for the limit."""
        return self.answer is None or now - self._heard > self._limit_ms * MS

    def order(self, controls: Controls, age: float, driven: bool, now: int) -> Order:
        """What to send now.

        Args:
            age: milliseconds of the driver's command.
            driven: the car unit stands for no stop of its own: its driver has confirmed all that it knows of.
        """
        self._number += 1
        if self.answer is None:
            return Order(self._session, self._number, 0, 0, 0.0, Command(controls))
        if self.answer.standing:  # the throttle waits for the translator
            controls = replace(controls, throttle=0.0)
        agree = driven and self.answer.standing
        held = (now - self._heard) // 1000
        return Order(self._session, self._number, self.answer.stamp, held, age, Command(controls, self._stop, agree))


def _sealed(data: bytes, key: bytes) -> bytes:
    return data + _tag(data, key) if key else data


def _opened(packet: bytes, key: bytes) -> bytes:
    if not key:
        return packet
    data, tag = packet[:-TAG], packet[-TAG:]
    if not hmac.compare_digest(tag, _tag(data, key)):
        raise Malformed("sealed by another key, or none")
    return data


def _tag(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()[:TAG]
