"""Protocol between onboard unit and vehicle adapter: orders, and answers to them (docs/teleoperation.md).

An order and its answer are one UDP packet each. An order has the controls to apply now, and the age of the driver's
command; an answer has the state of the vehicle. Both endpoints apply the rules of `control.safety`: an adapter that
receives no valid order within the limit stops the vehicle by itself. It leaves that stop only when the onboard unit
names it and agrees, which the onboard unit does after the driver has confirmed.

An adapter computes the age of an order from its own clock only: each answer contains a timestamp of it, and each order
the timestamp of the last answer, and how long ago the onboard unit received it. So a packet that was queued or recorded
is old. Numbers are little-endian. If a key is set, packets end with 16 bytes of HMAC-SHA-256 over all preceding bytes.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import struct
from dataclasses import dataclass, replace

from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Malformed
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS, NS_PER_MS, SafetyMonitor

ADAPTER_PERIOD_MS = 10.0
"""Interval at which an adapter processes orders and controls the vehicle."""
PACKET_MAX_BYTES = 1400
"""Maximum size of a packet."""
NEVER_MS = 1e9
"""Age of an answer that never arrived, ms."""
TAG_BYTES = 16
"""Length of a packet's HMAC."""
_ORDER = struct.Struct("<2sIIqIf")
_ANSWER = struct.Struct("<2sqIBfBddfb")
_ORDER_MAGIC, _ANSWER_MAGIC = b"O1", b"A1"
_STOPPED_FLAG = 1
_POSITION_KNOWN, _HEADING_KNOWN, _SPEED_KNOWN = 1, 2, 4


@dataclass(frozen=True)
class Order:
    """What the vehicle is to do.

    Attributes:
        session: of the onboard unit; it has another one each time that it starts.
        number: counts the orders of a session.
        stamp: timestamp of the last answer; 0: there was none.
        held: time since that answer was received, microseconds.
        age: age of the driver's command, milliseconds; 0 if the onboard unit itself stops the vehicle.
        command: controls; number of the adapter's known stop; whether that stop may be left.
    """

    session: int
    number: int
    stamp: int
    held: int
    age: float
    command: Command

    def pack(self, key: bytes = b"") -> bytes:
        """Encode as a packet."""
        head = _ORDER.pack(_ORDER_MAGIC, self.session, self.number, self.stamp, min(self.held, 2**32 - 1), self.age)
        return _sign(head + self.command.pack(), key)

    @staticmethod
    def unpack(packet: bytes, key: bytes = b"") -> Order:
        """Decode a packet.

        Raises:
            Malformed: it is not an order, or was signed with another key.
        """
        data = _verify(packet, key)
        try:
            kind, session, number, stamp, held, age = _ORDER.unpack_from(data)
        except struct.error as error:
            raise Malformed(str(error)) from None
        if kind != _ORDER_MAGIC or not 0 <= age < 1e9:
            raise Malformed("not an order")
        return Order(session, number, stamp, held, age, Command.unpack(data[_ORDER.size :]))


@dataclass(frozen=True)
class Answer:
    """State of the vehicle and its adapter.

    Attributes:
        stamp: timestamp of the adapter's clock.
        stop: number of its last stop; standing: whether the vehicle is still stopped for it; reason: of that stop.
        vehicle: state that the vehicle reports.
    """

    stamp: int
    stop: int
    standing: bool
    reason: str
    vehicle: VehicleState

    def pack(self, key: bytes = b"") -> bytes:
        """Encode as a packet; faults that exceed the packet size are truncated."""
        v = self.vehicle
        known = _POSITION_KNOWN * (v.position is not None) | _HEADING_KNOWN * (v.heading is not None)
        known |= _SPEED_KNOWN * (v.speed is not None)
        x, y = v.position or (0.0, 0.0)
        head = _ANSWER.pack(
            _ANSWER_MAGIC,
            self.stamp,
            self.stop,
            _STOPPED_FLAG * self.standing,
            v.speed or 0.0,
            known,
            x,
            y,
            v.heading or 0.0,
            v.gear,
        )
        lines = "\n".join(text.replace("\n", " ") for text in (self.reason, *v.faults)).encode()
        return _sign((head + lines)[: PACKET_MAX_BYTES - TAG_BYTES], key)

    @staticmethod
    def unpack(packet: bytes, key: bytes = b"") -> Answer:
        """Decode a packet.

        Raises:
            Malformed: it is not an answer, or was signed with another key.
        """
        data = _verify(packet, key)
        try:
            kind, stamp, stop, flags, speed, known, x, y, heading, gear = _ANSWER.unpack_from(data)
            gear_ = Gear(gear)
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None
        finite = all(abs(number) < 1e9 for number in (speed, x, y, heading))  # False for NaN as well
        if kind != _ANSWER_MAGIC or not finite:
            raise Malformed("not an answer")
        reason, *faults = data[_ANSWER.size :].decode(errors="replace").split("\n")
        position = (x, y) if known & _POSITION_KNOWN else None
        vehicle = VehicleState(
            speed if known & _SPEED_KNOWN else None,
            position,
            heading if known & _HEADING_KNOWN else None,
            gear_,
            tuple(faults),
        )
        return Answer(stamp, stop, bool(flags & _STOPPED_FLAG), reason, vehicle)


class AdapterEndpoint:
    """The adapter's endpoint: which orders are obeyed, and what the vehicle does without; no thread, no network.

    Orders of one onboard unit are obeyed until it is silent for the limit; then another one may take over.

    Attributes:
        safety: the adapter's own safety monitor.
    """

    def __init__(self, limit_ms: float = COMMAND_MAX_AGE_MS) -> None:
        # random, so that timestamps and stops of an earlier adapter process are not valid for this one
        self.safety = SafetyMonitor(limit_ms, first_stop=secrets.randbits(30))
        self._base = secrets.randbits(61)
        self._session: int | None = None
        self._last_received = 0

    def receive(self, order: Order, now: int) -> bool:
        """Process an order received at time `now` (ns); returns whether it was valid."""
        silent = self._session is None or now - self._last_received > self.safety.limit_ms * NS_PER_MS
        if silent and order.session != self._session:
            self._session = order.session
            self.safety.begin(order.session, "an onboard unit has connected")
        if order.session == self._session:
            self._last_received = now
        sent = order.stamp - self._base + order.held * 1000  # earliest possible time
        created = sent - round(order.age * NS_PER_MS)
        return self.safety.receive(order.session, order.number, order.command, created, now)

    def check(self, now: int) -> Controls:
        """Controls to apply now."""
        return self.safety.check(now)

    def answer(self, vehicle: VehicleState, now: int) -> Answer:
        """Answer to an order."""
        return Answer(self._base + now, self.safety.stop, self.safety.standing, self.safety.reason, vehicle)


class OnboardEndpoint:
    """The onboard unit's endpoint: creates orders, and tracks its adapter's state; no thread, no network.

    Attributes:
        answer: the latest; None: there was none.
    """

    def __init__(self, limit_ms: float = COMMAND_MAX_AGE_MS) -> None:
        self.answer: Answer | None = None
        self._limit_ms = limit_ms
        self._session, self._number = secrets.randbits(32), 0
        self._last_received, self._stop = 0, 0

    def receive(self, answer: Answer, now: int) -> str | None:
        """Process an answer received at time `now` (ns); returns why to stop, if the adapter has newly stopped."""
        if self.answer is not None and answer.stamp < self.answer.stamp and not self.silent(now):
            return None  # overtaken by a later one; after silence the adapter may have restarted
        stopped = answer.standing and answer.stop != self._stop
        self.answer, self._last_received, self._stop = answer, now, answer.stop
        return f"the vehicle adapter stopped: {answer.reason}" if stopped else None

    def silent(self, now: int) -> bool:
        """Whether no answer has arrived within the limit."""
        return self.answer_age_ms(now) > self._limit_ms

    def answer_age_ms(self, now: int) -> float:
        """Time since the last answer was received, ms; `NEVER_MS` if there was none."""
        return NEVER_MS if self.answer is None else (now - self._last_received) / NS_PER_MS

    def order(self, controls: Controls, age: float, driven: bool, now: int) -> Order:
        """Order to send now.

        Args:
            age: age of the driver's command, milliseconds.
            driven: the onboard unit is not stopped: its driver has confirmed all stops known to it.
        """
        self._number += 1
        if self.answer is None:
            return Order(self._session, self._number, 0, 0, 0.0, Command(controls))
        if self.answer.standing:  # no throttle before the adapter has left its stop
            controls = replace(controls, throttle=0.0)
        agree = driven and self.answer.standing
        held = max(0, now - self._last_received) // 1000  # an answer may arrive after a waiting caller took its time
        return Order(self._session, self._number, self.answer.stamp, held, age, Command(controls, self._stop, agree))


def _sign(data: bytes, key: bytes) -> bytes:
    return data + _tag(data, key) if key else data


def _verify(packet: bytes, key: bytes) -> bytes:
    if not key:
        return packet
    data, tag = packet[:-TAG_BYTES], packet[-TAG_BYTES:]
    if not hmac.compare_digest(tag, _tag(data, key)):
        raise Malformed("signed with another key, or not signed")
    return data


def _tag(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()[:TAG_BYTES]
