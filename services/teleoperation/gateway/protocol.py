"""What parties and their gateway say to each other: JSON, a line a message (`stream`); never in the way of driving.

To the gateway: `Hello`, `Status` once a second, `Ask`. From it: `Join`, `Release`, `Refused`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from scan2sim.services.teleoperation.control.messages import Malformed

VERSION = 1
T = TypeVar("T")
Name = Annotated[str, Field(min_length=1, max_length=60)]
Text = Annotated[str, Field(max_length=200)]
Count = Annotated[int, Field(ge=0, le=2**53)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Said(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")  # newer parties may say more

    def wire(self) -> dict[str, Any]:
        """As it is sent."""
        return self.model_dump(mode="json")


class Address(_Said):
    """Where a station listens (UDP)."""

    host: Annotated[str, Field(min_length=1, max_length=255)]
    port: Annotated[int, Field(ge=1, le=65535)]


class Member(_Said):
    """Of a pair, as the other one is told: its name, and its certificate's SHA-256 (hexadecimal)."""

    name: Name
    fingerprint: Annotated[str, Field(pattern="[0-9a-f]{64}")]


class Driving(_Said):
    """A pair that a party is in."""

    pair: Count
    other: Name


class Hello(_Said):
    """A party's first message; role and name are its certificate's.

    Attributes:
        version: of this protocol.
        listening: where a station can be dialled.
        cameras: a vehicle's, by name.
        driving: the pair that it is in: it goes on while the gateway is away.
    """

    kind: Literal["hello"] = "hello"
    version: int = VERSION
    listening: Annotated[tuple[Address, ...], Field(max_length=16)] = ()
    cameras: Annotated[tuple[Name, ...], Field(max_length=64)] = ()
    driving: Driving | None = None


class LinkStatus(_Said):
    """How a link is; None: not known yet. Milliseconds there and back; share of packets lost; Mbit/s both ways."""

    name: Name
    up: bool
    round_trip: Finite | None = None
    loss: Finite | None = None
    rate: Finite = 0.0


class Status(_Said):
    """How a party is.

    Attributes:
        pair: that it is in.
        links: to the other of the pair.
        driving: whether somebody drives now.
        told: what the driver or operator should know: why the vehicle stands, whose clock is wrong.
        speed: m/s, a vehicle's.
        age: ms, of the last command where it is a vehicle, of pictures where it is a station.
    """

    kind: Literal["status"] = "status"
    pair: Count | None = None
    links: Annotated[tuple[LinkStatus, ...], Field(max_length=64)] = ()
    driving: bool = False
    told: Text = ""
    speed: Finite | None = None
    age: Finite | None = None


class Ask(_Said):
    """A station's driver wants a vehicle, or has arrived."""

    kind: Literal["ask"] = "ask"
    what: Literal["join", "release"]
    vehicle: Name


class Join(_Said):
    """The party is to be in this pair, and in no other; to both, and again whenever they come back."""

    kind: Literal["join"] = "join"
    pair: Count
    other: Member
    listening: tuple[Address, ...] = ()


class Release(_Said):
    """The party is to be in no pair."""

    kind: Literal["release"] = "release"
    why: Text = ""


class Refused(_Said):
    """What was asked isn't done."""

    kind: Literal["refused"] = "refused"
    cause: Text


ToGateway = Annotated[Hello | Status | Ask, Field(discriminator="kind")]
FromGateway = Annotated[Join | Release | Refused, Field(discriminator="kind")]
_TO: TypeAdapter[Hello | Status | Ask] = TypeAdapter(ToGateway)
_FROM: TypeAdapter[Join | Release | Refused] = TypeAdapter(FromGateway)


def to_gateway(told: Mapping[str, Any]) -> Hello | Status | Ask:
    """What a party says.

    Raises:
        Malformed: it is nothing that it may say.
    """
    return _read(_TO, told)


def from_gateway(told: Mapping[str, Any]) -> Join | Release | Refused:
    """What the gateway says.

    Raises:
        Malformed: it is nothing that it may say.
    """
    return _read(_FROM, told)


def _read(adapter: TypeAdapter[T], told: Mapping[str, Any]) -> T:
    try:
        return adapter.validate_python(told)
    except ValidationError as error:
        raise Malformed(str(error.errors()[0]["msg"])) from None
