"""Messages between parties and gateway: JSON, one message per line (`json_stream`); driving doesn't depend on them.

To the gateway: `Hello`, `Status` once a second, `DriverRequest`, `DriverEvent`. From it: `Join`, `Release`,
`RequestRejected`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from scan2sim.services.teleoperation.control.messages import Malformed

PROTOCOL_VERSION = 2
NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")
"""Name of a vehicle, station or driver; it becomes part of paths, pages and logs."""
T = TypeVar("T")
Name = Annotated[str, Field(min_length=1, max_length=60)]
Text = Annotated[str, Field(max_length=200)]
Count = Annotated[int, Field(ge=0, le=2**53)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")  # newer versions may send more fields

    def wire(self) -> dict[str, Any]:
        """The message as it is sent."""
        return self.model_dump(mode="json")


class Address(_Message):
    """UDP address that a station listens on."""

    host: Annotated[str, Field(min_length=1, max_length=255)]
    port: Annotated[int, Field(ge=1, le=65535)]


class PairMember(_Message):
    """Member of a pair, as sent to the other member: name, and SHA-256 of the certificate (hexadecimal)."""

    name: Name
    fingerprint: Annotated[str, Field(pattern="[0-9a-f]{64}")]


class CurrentPair(_Message):
    """The pair that a party is in."""

    pair: Count
    other: Name


class Hello(_Message):
    """First message of a party; role and name are those of its certificate.

    Attributes:
        version: of this protocol.
        listening: addresses that vehicles can connect to, of a station.
        cameras: names of a vehicle's cameras.
        driving: the party's current pair, which keeps driving while the gateway is away.
    """

    kind: Literal["hello"] = "hello"
    version: int = PROTOCOL_VERSION
    listening: Annotated[tuple[Address, ...], Field(max_length=16)] = ()
    cameras: Annotated[tuple[Name, ...], Field(max_length=64)] = ()
    driving: CurrentPair | None = None


class LinkStatus(_Message):
    """State of a link: round-trip time in ms, share of packets lost, Mbit/s both ways; None: not known yet.

    Attributes:
        silent_ms: time since anything was received over it.
    """

    name: Name
    up: bool
    round_trip: Finite | None = None
    loss: Finite | None = None
    rate: Finite = 0.0
    silent_ms: Finite | None = None


class Status(_Message):
    """Status of a party.

    Attributes:
        pair: number of its pair.
        links: to the other party of the pair.
        driving: whether somebody drives now.
        message: for driver or operator: why the vehicle is stopped, or which clock is wrong.
        speed: of a vehicle, m/s.
        age: ms; of the last command for a vehicle, of the video for a station.
        driver: who has control at a station; empty: nobody.
        held: seconds since that driver took control.
    """

    kind: Literal["status"] = "status"
    pair: Count | None = None
    links: Annotated[tuple[LinkStatus, ...], Field(max_length=64)] = ()
    driving: bool = False
    message: Text = ""
    speed: Finite | None = None
    age: Finite | None = None
    driver: Text = ""
    held: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0


class DriverRequest(_Message):
    """Request of a station's driver to join or to release a vehicle; `driver`: who, if the station knows."""

    kind: Literal["request"] = "request"
    what: Literal["join", "release"]
    vehicle: Name
    driver: Text = ""


class DriverEvent(_Message):
    """What a station's driver did, for the audit trail; `time`: Unix time of the station, seconds."""

    kind: Literal["event"] = "event"
    what: Text
    driver: Text
    time: Finite


class Join(_Message):
    """Order to join a pair and no other; sent to both parties, and again when one reconnects."""

    kind: Literal["join"] = "join"
    pair: Count
    other: PairMember
    listening: tuple[Address, ...] = ()


class Release(_Message):
    """Order to leave the current pair."""

    kind: Literal["release"] = "release"
    why: Text = ""


class RequestRejected(_Message):
    """The request was rejected, or the message was not accepted."""

    kind: Literal["rejected"] = "rejected"
    cause: Text


_ToGateway = Hello | Status | DriverRequest | DriverEvent
ToGateway = Annotated[_ToGateway, Field(discriminator="kind")]
FromGateway = Annotated[Join | Release | RequestRejected, Field(discriminator="kind")]
_TO_GATEWAY: TypeAdapter[_ToGateway] = TypeAdapter(ToGateway)
_FROM_GATEWAY: TypeAdapter[Join | Release | RequestRejected] = TypeAdapter(FromGateway)


def to_gateway(data: Mapping[str, Any]) -> _ToGateway:
    """Validate a message of a party.

    Raises:
        Malformed: it is not a message that a party may send.
    """
    return _read(_TO_GATEWAY, data)


def from_gateway(data: Mapping[str, Any]) -> Join | Release | RequestRejected:
    """Validate a message of the gateway.

    Raises:
        Malformed: it is not a message that the gateway may send.
    """
    return _read(_FROM_GATEWAY, data)


def _read(adapter: TypeAdapter[T], data: Mapping[str, Any]) -> T:
    try:
        return adapter.validate_python(data)
    except ValidationError as error:
        raise Malformed(str(error.errors()[0]["msg"])) from None
