"""What a vehicle and its station say to each other, as bytes; each message goes over all links (`bundle`).

A message is a header (kind, number, sending time) and a body by its kind. Times are nanoseconds of the sender's
monotonic clock, which no NTP daemon sets back; `clocks` knows how far the two are apart. Numbers are little-endian.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Annotated, Any, Self

from pydantic import Field, TypeAdapter, ValidationError

from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState


class Kind(IntEnum):
    """Of a message: to the vehicle, to the station, or either way."""

    COMMAND = 1
    """To the vehicle: `Command`."""
    TELEMETRY = 2
    """To the station: `Telemetry`."""
    PING = 3
    """Either way: `clocks`."""
    PONG = 4
    """Either way: `clocks`."""
    KEY = 5
    """To the station: `Key` of the video's encryption."""
    WANTED = 6
    """To the vehicle: `Wanted`, a key frame."""
    REPORT = 7
    """To the vehicle: `Report` of how the video comes."""
    STREAMS = 8
    """To the station: `Streams`, what cameras there are."""
    LACKING = 9
    """To the vehicle: `Lacking`, packets of video that are to be sent again."""


HEADER = struct.Struct("<BQq")
LARGEST = 1100
"""Bytes of a message with its header, so that with DTLS, UDP and IP it fits into any network's packet."""


class Malformed(ValueError):
    """Bytes that are no message."""


@dataclass(frozen=True)
class Message:
    """As it goes over the links.

    Attributes:
        number: counts the sender's messages from 0, whatever their kind.
        sent: nanoseconds of the sender's monotonic clock.
    """

    kind: Kind
    number: int
    sent: int
    body: bytes

    def pack(self) -> bytes:
        """As bytes."""
        return HEADER.pack(self.kind, self.number, self.sent) + self.body

    @staticmethod
    def unpack(data: bytes) -> Message:
        """Of bytes.

        Raises:
            Malformed: they are none.
        """
        try:
            kind, number, sent = HEADER.unpack_from(data)
            return Message(Kind(kind), number, sent, data[HEADER.size :])
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None


_COMMAND = struct.Struct("<fffbBI")
_HORN, _LIGHTS, _AGREE = 1, 2, 4


@dataclass(frozen=True)
class Command:
    """A driver's controls.

    Attributes:
        stop: number of the stop that the driver has seen last.
        agree: the driver confirms that the vehicle may leave that stop.
    """

    controls: Controls
    stop: int = 0
    agree: bool = False

    def pack(self) -> bytes:
        """As a message's body."""
        c = self.controls
        flags = _HORN * c.horn | _LIGHTS * c.lights | _AGREE * self.agree
        return _COMMAND.pack(c.steering, c.throttle, c.brake, c.gear, flags, self.stop)

    @staticmethod
    def unpack(body: bytes) -> Command:
        """Of a message's body.

        Raises:
            Malformed: it is none, or asks for what can't be.
        """
        try:
            steering, throttle, brake, gear, flags, stop = _COMMAND.unpack(body)
            way = Gear(gear)
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None
        if not (abs(steering) <= 1 and 0 <= throttle <= 1 and 0 <= brake <= 1):  # refuses what is no number, too
            raise Malformed("controls beyond their ranges")
        controls = Controls(steering, throttle, brake, way, bool(flags & _HORN), bool(flags & _LIGHTS))
        return Command(controls, stop, bool(flags & _AGREE))


_KEY = struct.Struct("<I44s")


@dataclass(frozen=True)
class Key:
    """Of the video's encryption, from a generation on: 32 bytes of key and 12 of salt (RFC 7714)."""

    generation: int
    secret: bytes

    def pack(self) -> bytes:
        """As a message's body."""
        return _KEY.pack(self.generation, self.secret)

    @staticmethod
    def unpack(body: bytes) -> Key:
        """Of a message's body; raises Malformed."""
        try:
            return Key(*_KEY.unpack(body))
        except struct.error as error:
            raise Malformed(str(error)) from None


@dataclass(frozen=True)
class Wanted:
    """A key frame is wanted of a camera."""

    camera: int

    def pack(self) -> bytes:
        """As a message's body."""
        return struct.pack("<B", self.camera)

    @staticmethod
    def unpack(body: bytes) -> Wanted:
        """Of a message's body; raises Malformed."""
        try:
            return Wanted(*struct.unpack("<B", body))
        except struct.error as error:
            raise Malformed(str(error)) from None


@dataclass(frozen=True)
class Lacking:
    """Packets of a source of video (SSRC) that didn't come, by their sequence."""

    source: int
    sequences: tuple[int, ...]

    def pack(self) -> bytes:
        """As a message's body."""
        return struct.pack(f"<I{len(self.sequences)}H", self.source, *self.sequences)

    @staticmethod
    def unpack(body: bytes) -> Lacking:
        """Of a message's body; raises Malformed."""
        try:
            source, *sequences = struct.unpack(f"<I{(len(body) - 4) // 2}H", body)
        except struct.error as error:
            raise Malformed(str(error)) from None
        return Lacking(source, tuple(sequences))


class _Told:
    """Said seldom, as JSON: easier to read in a capture, and to add to."""

    def pack(self) -> bytes:
        """As a message's body."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()  # type: ignore[call-overload]

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Of a message's body.

        Raises:
            Malformed: it is none.
        """
        try:
            found: Self = _adapter(cls).validate_python(json.loads(body, parse_constant=_refuse))
        except (ValidationError, ValueError, RecursionError) as error:
            raise Malformed(str(error)[:200]) from None
        return found


_ADAPTERS: dict[type[_Told], TypeAdapter[Any]] = {}


def _adapter(told: type[_Told]) -> TypeAdapter[Any]:
    """What reads a body: to make it takes longer than a hundred readings."""
    if told not in _ADAPTERS:
        _ADAPTERS[told] = TypeAdapter(told)
    return _ADAPTERS[told]


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


Name = Annotated[str, Field(max_length=60)]
Count = Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class Telemetry(_Told):
    """How the vehicle is.

    Attributes:
        vehicle: what it tells of itself.
        stop: number of its last stop; standing: whether it still stands for it; reason: why.
        command: number of the last message that it obeyed; age: ms of that one when it was.
        dropped: messages that were not obeyed so far, by why.
    """

    vehicle: VehicleState
    stop: Count
    standing: bool
    reason: Annotated[str, Field(max_length=200)]
    command: int
    age: float
    dropped: dict[Name, Count]


@dataclass(frozen=True)
class Report(_Told):
    """How a camera's video came over the last second.

    Attributes:
        received, lost: packets; such that had to be sent again are among the lost.
        delay: ms from the camera to here, the median; None: no picture was whole.
        links: bytes a second that came by each link, by its name.
    """

    camera: Count
    received: Count
    lost: Count
    delay: float | None
    links: dict[Name, float]


@dataclass(frozen=True)
class Stream:
    """A camera's video; fps 0: the camera is gone."""

    camera: Count
    name: Name
    width: Count
    height: Count
    fps: float


@dataclass(frozen=True)
class Streams(_Told):
    """All cameras."""

    cameras: tuple[Stream, ...]
