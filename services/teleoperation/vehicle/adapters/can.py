"""Vehicles with a CAN bus, as a DBC file describes their messages (python-can, cantools).

Controls become the whole range that the file gives a signal: steering from its least to its greatest value, throttle
and brake from 0 to the greatest. Vehicles whose messages want checksums, or a handshake before they obey, take a file
of their own beside this one.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import Unreachable, Vehicle

NEEDS = ("can", "cantools")
EXAMPLE = Path(__file__).parents[1] / "examples" / "example.dbc"
UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "kph": 1 / 3.6, "kmh": 1 / 3.6, "mph": 0.44704, "": 1.0}
"""Of speeds, in metres a second."""
AGAIN, QUIET = 1.0, 1.0
"""Seconds between attempts to open a bus; without a word from the vehicle until that is told."""
AT_ONCE = 200
"""Messages that are read at a time, at most: in ten milliseconds no bus carries more."""
FULL = Controls(1.0, 1.0, 1.0, Gear.FORWARD, horn=True, lights=True)
Signal = Annotated[str, Field(max_length=200)]


class Params(step.Params):
    """Of a vehicle with a CAN bus; signals are named as MESSAGE.SIGNAL, "" where the vehicle has none."""

    dbc: Annotated[File, Field(description="DBC file of its messages.")] = EXAMPLE
    interface: Annotated[str, Field(description="What the bus is reached by, as python-can names it.")] = "socketcan"
    channel: Annotated[str, Field(description="Which bus of that.")] = "can0"
    bitrate: Annotated[int, Field(ge=0, le=10**8, description="Bits a second; 0: as the interface is set.")] = 0
    steering: Annotated[Signal, Field(description="Its least value is full right; -MESSAGE.SIGNAL: full left.")] = (
        "DriveCommand.Steering"
    )
    throttle: Signal = "DriveCommand.Throttle"
    brake: Signal = "DriveCommand.Brake"
    gear: Signal = "DriveCommand.Gear"
    horn: Signal = "BodyCommand.Horn"
    lights: Signal = "BodyCommand.Lights"
    counter: Annotated[Signal, Field(description="One more in each message of its own.")] = "DriveCommand.Counter"
    speed: Annotated[Signal, Field(description="Of the vehicle, in the unit that the file says.")] = "Motion.Speed"
    gear_in: Annotated[Signal, Field(description="The gear that is in; without one, the one that was asked for.")] = (
        "Motion.GearIn"
    )
    gears: Annotated[
        tuple[str, str, str], Field(description="What the signal's values for reverse, neutral, forward are called.")
    ] = ("Reverse", "Neutral", "Forward")


def connect(params: Params) -> Vehicle:
    """See `translators.Translator`."""
    return CanVehicle(params)


class CanVehicle:
    """See `translators.Vehicle`.

    Raises:
        InputError: the DBC file can't be read, or lacks what is named.
        SettingError: python-can has no such interface.
    """

    def __init__(self, params: Params) -> None:
        self._params = params
        self._signals = Signals(params)
        self._bus: Any = None
        self._tried, self._count = 0.0, 0
        self._speed, self._gear, self._heard = 0.0, Gear.NEUTRAL, time.monotonic()
        self._open()

    def obey(self, controls: Controls) -> None:
        """Send all messages, and read what the vehicle says."""
        import can

        if self._bus is None and (time.monotonic() - self._tried < AGAIN or not self._open()):
            raise Unreachable(self._gone())
        self._count += 1
        try:
            for message, data in self._signals.messages(controls, self._count):
                self._bus.send(
                    can.Message(arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, data=data)
                )
            self._listen()
        except (can.CanError, OSError) as error:
            self._leave()
            raise Unreachable(f"{self._gone()} ({error})") from None
        if "gear_in" not in self._signals.told:
            self._gear = controls.gear

    def state(self) -> VehicleState:
        """Its speed and gear, where it tells them."""
        silent = self._signals.told and time.monotonic() - self._heard > QUIET
        faults = (f"the vehicle says nothing on {self._params.channel}",) if silent else ()
        if self._bus is None:
            faults = (self._gone(),)
        return VehicleState(self._speed, gear=self._gear, faults=faults)

    def close(self) -> None:
        """Leave the bus."""
        self._leave()

    def _gone(self) -> str:
        return f"the CAN bus {self._params.channel} is gone"

    def _open(self) -> bool:
        import can

        self._tried = time.monotonic()
        how: dict[str, Any] = {"bitrate": self._params.bitrate} if self._params.bitrate else {}
        try:
            self._bus = can.Bus(self._params.channel, interface=self._params.interface, **how)
        except (can.CanInterfaceNotImplementedError, ValueError, TypeError, ImportError) as error:
            where = f"interface={self._params.interface}"
            raise SettingError(where, f"can't be used ({error})", "Name one that python-can has: socketcan") from None
        except (can.CanError, OSError):
            return False
        return True

    def _leave(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def _listen(self) -> None:
        for _ in range(AT_ONCE):
            message = self._bus.recv(timeout=0)
            if message is None:
                return
            said = self._signals.read(message)
            if said:
                self._heard = time.monotonic()
            self._speed = said.get("speed", self._speed)
            self._gear = Gear(int(said.get("gear_in", self._gear)))


class Signals:
    """A DBC file's messages, by what controls are called.

    Attributes:
        told: message and signal of what the vehicle tells: "speed", "gear_in".

    Raises:
        InputError: the file can't be read, or lacks what is named.
    """

    def __init__(self, params: Params) -> None:
        import cantools

        self._path = params.dbc
        try:
            self._file: Any = cantools.database.load_file(params.dbc, "dbc", strict=True)
        except OSError as error:
            raise InputError(params.dbc, str(error.strerror), "Name the vehicle's DBC file by --set dbc=") from None
        except (cantools.Error, ValueError) as error:
            raise InputError(params.dbc, f"is no DBC file ({str(error)[:200]})", "Look at it in a DBC editor") from None
        self._turned = params.steering.startswith("-")
        names = {
            name: str(getattr(params, name)) for name in ("throttle", "brake", "gear", "horn", "lights", "counter")
        }
        names["steering"] = params.steering.removeprefix("-")
        self._found = {name: self._find(name, full) for name, full in names.items() if full}
        for must in ("steering", "throttle", "brake"):
            if must not in self._found:
                raise SettingError(must, "names no signal: a vehicle can't be driven without", "Give MESSAGE.SIGNAL")
            self._range(must)
        self._gears = self._values(self._found["gear"], params.gears) if "gear" in self._found else {}
        messages = {message.frame_id: message for message, _ in self._found.values()}
        for message in messages.values():
            if message.is_multiplexed():
                raise InputError(self._path, f"{message.name} is multiplexed", "Write a translator for this vehicle")
        self._others = {key: self._resting(message) for key, message in messages.items()}
        self._messages = list(messages.values())
        told = {"speed": params.speed, "gear_in": params.gear_in}
        self.told = {name: self._find(name, full) for name, full in told.items() if full}
        if "speed" in self.told and (unit := self.told["speed"][1].unit or "") not in UNITS:
            known = ", ".join(filter(None, UNITS))
            raise InputError(self._path, f"{params.speed} is in {unit!r}", f"Have it in one of: {known}")
        self._gears_in = {}
        if "gear_in" in self.told:
            self._gears_in = {number: gear for gear, number in self._values(self.told["gear_in"], params.gears).items()}
        for controls in (FULL, replace(FULL, steering=-1.0, gear=Gear.REVERSE), STOP):
            self.messages(controls, 0)

    def messages(self, controls: Controls, count: int) -> list[tuple[Any, bytes]]:
        """Messages, and their bytes, that ask for these controls."""
        asked: dict[str, float] = {
            "throttle": controls.throttle * self._range("throttle")[1],
            "brake": controls.brake * self._range("brake")[1],
            "horn": controls.horn,
            "lights": controls.lights,
        }
        least, most = self._range("steering")
        way = -controls.steering if self._turned else controls.steering
        asked["steering"] = way * most if way > 0 else -way * least
        if "gear" in self._found:
            asked["gear"] = self._gears[controls.gear]
        if "counter" in self._found:
            asked["counter"] = count % 2 ** self._found["counter"][1].length
        said = {key: dict(values) for key, values in self._others.items()}
        for name, (message, signal) in self._found.items():
            said[message.frame_id][signal.name] = asked[name]
        return [(message, self._encoded(message, said[message.frame_id])) for message in self._messages]

    def _encoded(self, message: Any, said: dict[str, float]) -> bytes:
        import cantools

        try:
            return bytes(message.encode(said))
        except (cantools.Error, ValueError, OverflowError) as error:
            raise InputError(
                self._path, f"{message.name} can't be made ({error})", "Check its signals' ranges"
            ) from None

    def read(self, message: Any) -> dict[str, float]:
        """What a message of the vehicle tells: "speed", metres a second, "gear_in"."""
        import cantools

        said: dict[str, float] = {}
        for name, (described, signal) in self.told.items():
            if message.arbitration_id != described.frame_id:
                continue
            try:
                value = float(described.decode(message.data, decode_choices=False)[signal.name])
            except (cantools.Error, ValueError, KeyError):  # too short: it told nothing
                continue
            if name == "speed":
                said[name] = value * UNITS[signal.unit or ""]
            elif value in self._gears_in:
                said[name] = self._gears_in[int(value)]
        return said

    def _find(self, name: str, full: str) -> tuple[Any, Any]:
        message, _, leaf = full.partition(".")
        known = {one.name: one for one in self._file.messages}
        remedy = f"Name it by --set {name}=MESSAGE.SIGNAL"
        if message not in known:
            raise InputError(self._path, f"has no message {message!r} for {name}", f"{remedy}; it has {_some(known)}")
        signals = {one.name: one for one in known[message].signals}
        if leaf not in signals:
            cause = f"{message} has no signal {leaf!r} for {name}"
            raise InputError(self._path, cause, f"{remedy}; {message} has {_some(signals)}")
        return known[message], signals[leaf]

    def _range(self, name: str) -> tuple[float, float]:
        """Of a signal: its least and greatest value."""
        message, signal = self._found[name]
        if not signal.maximum or (name == "steering" and not signal.minimum):  # None or 0: the file says nothing
            cause = f"{message.name}.{signal.name} has no range, so nobody knows what full {name} is"
            raise InputError(self._path, cause, "Give it one in the file: [-0.6|0.6]")
        return float(signal.minimum or 0), float(signal.maximum)

    def _values(self, found: tuple[Any, Any], names: tuple[str, str, str]) -> dict[Gear, int]:
        """Of a gear's signal, by gears."""
        message, signal = found
        values = {str(text): number for number, text in (signal.choices or {}).items()}
        lacking = [name for name in names if name not in values]
        if lacking:
            cause = f"{message.name}.{signal.name} has no value called {lacking[0]!r}"
            raise InputError(self._path, cause, f'Name them by --set gears=["R","N","F"]; it has {_some(values)}')
        return dict(zip((Gear.REVERSE, Gear.NEUTRAL, Gear.FORWARD), (values[name] for name in names), strict=True))

    @staticmethod
    def _resting(message: Any) -> dict[str, float]:
        """What signals that nothing is asked of say: their first value in the file, else 0 or what is next to it."""
        return {
            one.name: one.initial if one.initial is not None else max(one.minimum or 0, min(0, one.maximum or 0))
            for one in message.signals
        }


def _some(names: Mapping[str, Any]) -> str:
    listed = sorted(names)
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
