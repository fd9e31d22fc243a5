"""Messages between vehicle and station, as bytes; each message goes over all links (`transport.multipath`).

A message is a header (kind, number, sending time) and a body, whose layout depends on the kind. Times are nanoseconds
of the sender's monotonic clock, which no NTP daemon sets back; `clock_sync` estimates the offset of the two clocks.
Numbers are little-endian.
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
    """Kind of a message, and the direction it is sent in."""

    COMMAND = 1
    """To the vehicle: `Command`."""
    TELEMETRY = 2
    """To the station: `Telemetry`."""
    PING = 3
    """Either way: measures clock offset and link quality (`clock_sync`)."""
    PONG = 4
    """Either way: answer to a ping."""
    VIDEO_KEY = 5
    """To the station: `VideoKey`, a key of the video encryption."""
    KEY_FRAME_REQUEST = 6
    """To the vehicle: `KeyFrameRequest`."""
    VIDEO_REPORT = 7
    """To the vehicle: `VideoReport`, receiver statistics of a camera's video."""
    STREAMS = 8
    """To the station: `VideoStreams`, the list of cameras."""
    NACK = 9
    """To the vehicle: `Nack`, video packets to retransmit."""
    CONGESTION = 10
    """To the vehicle: `CongestionReport`, a queue grows on the links."""


HEADER = struct.Struct("<BQq")
MESSAGE_MAX_BYTES = 1100
"""Size of a message with its header, so that with DTLS, UDP and IP headers it fits the MTU of any network."""


class Malformed(ValueError):
    """Received bytes are not a valid message."""


@dataclass(frozen=True)
class Message:
    """A message on the links.

    Attributes:
        number: counts the sender's messages from 0, over all kinds.
        sent: nanoseconds of the sender's monotonic clock.
    """

    kind: Kind
    number: int
    sent: int
    body: bytes

    def pack(self) -> bytes:
        """Encode the message."""
        return HEADER.pack(self.kind, self.number, self.sent) + self.body

    @staticmethod
    def unpack(data: bytes) -> Message:
        """Decode a message.

        Raises:
            Malformed: the bytes are not a message.
        """
        try:
            kind, number, sent = HEADER.unpack_from(data)
            return Message(Kind(kind), number, sent, data[HEADER.size :])
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None


_COMMAND = struct.Struct("<fffbBI")
_HORN, _LIGHTS, _AGREE, _EMERGENCY = 1, 2, 4, 8


@dataclass(frozen=True)
class Command:
    """A driver's controls.

    Attributes:
        stop: number of the last stop that the driver has seen.
        agree: the driver confirms that the vehicle may leave that stop.
        emergency: the vehicle stops, and leaves this stop only after another confirmation.
    """

    controls: Controls
    stop: int = 0
    agree: bool = False
    emergency: bool = False

    def pack(self) -> bytes:
        """Encode as a message body."""
        c = self.controls
        flags = _HORN * c.horn | _LIGHTS * c.lights | _AGREE * self.agree | _EMERGENCY * self.emergency
        return _COMMAND.pack(c.steering, c.throttle, c.brake, c.gear, flags, self.stop)

    @staticmethod
    def unpack(body: bytes) -> Command:
        """Decode a message body.

        Raises:
            Malformed: the body is not a command, or a control is out of range.
        """
        try:
            steering, throttle, brake, gear, flags, stop = _COMMAND.unpack(body)
            gear_ = Gear(gear)
        except (struct.error, ValueError) as error:
            raise Malformed(str(error)) from None
        if not (abs(steering) <= 1 and 0 <= throttle <= 1 and 0 <= brake <= 1):  # rejects NaN as well
            raise Malformed("controls out of range")
        controls = Controls(steering, throttle, brake, gear_, bool(flags & _HORN), bool(flags & _LIGHTS))
        return Command(controls, stop, bool(flags & _AGREE), bool(flags & _EMERGENCY))


_VIDEO_KEY = struct.Struct("<I44s")


@dataclass(frozen=True)
class VideoKey:
    """Key of the video encryption, valid from a generation on: 32 bytes of key and 12 of salt (RFC 7714)."""

    generation: int
    secret: bytes

    def pack(self) -> bytes:
        """Encode as a message body."""
        return _VIDEO_KEY.pack(self.generation, self.secret)

    @staticmethod
    def unpack(body: bytes) -> VideoKey:
        """Decode a message body; raises Malformed."""
        try:
            return VideoKey(*_VIDEO_KEY.unpack(body))
        except struct.error as error:
            raise Malformed(str(error)) from None


@dataclass(frozen=True)
class KeyFrameRequest:
    """Request for a key frame of a camera."""

    camera: int

    def pack(self) -> bytes:
        """Encode as a message body."""
        return struct.pack("<B", self.camera)

    @staticmethod
    def unpack(body: bytes) -> KeyFrameRequest:
        """Decode a message body; raises Malformed."""
        try:
            return KeyFrameRequest(*struct.unpack("<B", body))
        except struct.error as error:
            raise Malformed(str(error)) from None


@dataclass(frozen=True)
class Nack:
    """Missing packets of a video source (SSRC), by sequence number."""

    source: int
    sequences: tuple[int, ...]

    def pack(self) -> bytes:
        """Encode as a message body."""
        return struct.pack(f"<I{len(self.sequences)}H", self.source, *self.sequences)

    @staticmethod
    def unpack(body: bytes) -> Nack:
        """Decode a message body; raises Malformed."""
        try:
            source, *sequences = struct.unpack(f"<I{(len(body) - 4) // 2}H", body)
        except struct.error as error:
            raise Malformed(str(error)) from None
        return Nack(source, tuple(sequences))


class _JsonBody:
    """Body of a rare message, as JSON: readable in a packet capture, and easy to extend."""

    def pack(self) -> bytes:
        """Encode as a message body."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()  # type: ignore[call-overload]

    @classmethod
    def unpack(cls, body: bytes) -> Self:
        """Decode a message body.

        Raises:
            Malformed: the body is not valid.
        """
        try:
            found: Self = _adapter(cls).validate_python(json.loads(body, parse_constant=_refuse))
        except (ValidationError, ValueError, RecursionError) as error:
            raise Malformed(str(error)[:200]) from None
        return found


_ADAPTERS: dict[type[_JsonBody], TypeAdapter[Any]] = {}


def _adapter(body_type: type[_JsonBody]) -> TypeAdapter[Any]:
    """Cached validator of a body: creating one takes longer than a hundred validations."""
    if body_type not in _ADAPTERS:
        _ADAPTERS[body_type] = TypeAdapter(body_type)
    return _ADAPTERS[body_type]


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number")


Name = Annotated[str, Field(max_length=60)]
Count = Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class Telemetry(_JsonBody):
    """State of the vehicle and of its safety monitor.

    Attributes:
        vehicle: state that the vehicle reports.
        stop: number of its last stop; standing: whether it is still stopped for it; reason: of that stop.
        command: number of the last obeyed message; age: age of that command when it was obeyed, ms.
        dropped: number of messages that were not obeyed so far, by reason.
        vehicle_age_ms: time since the vehicle adapter sent `vehicle`, ms; large if it never did.
    """

    vehicle: VehicleState
    stop: Count
    standing: bool
    reason: Annotated[str, Field(max_length=200)]
    command: int
    age: float
    dropped: dict[Name, Count]
    vehicle_age_ms: float = 0.0


@dataclass(frozen=True)
class VideoReport(_JsonBody):
    """Receiver statistics of a camera's video over the last second.

    Attributes:
        received, lost: packets; retransmitted packets count as lost.
        delay: median delay from the camera to the station, ms; None: no frame was complete.
        links: bytes/s received over each link, by its name.
    """

    camera: Count
    received: Count
    lost: Count
    delay: float | None
    links: dict[Name, float]


@dataclass(frozen=True)
class CongestionReport(_JsonBody):
    """A queue grows on the links.

    Attributes:
        rate: at which video arrives, bit/s for each camera.
        share: of the rate at which it was sent.
        queue_ms: delay in the queue, ms.
    """

    rate: Count
    share: float
    queue_ms: float


@dataclass(frozen=True)
class VideoStream:
    """Video stream of a camera; fps 0: the camera is offline."""

    camera: Count
    name: Name
    width: Count
    height: Count
    fps: float


@dataclass(frozen=True)
class VideoStreams(_JsonBody):
    """Video streams of all cameras."""

    cameras: tuple[VideoStream, ...]
