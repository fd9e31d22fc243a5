"""Vehicles with a CAN bus, whose messages are described by a DBC file (python-can, cantools).

Controls are mapped to the full range of a signal in the file: steering from its minimum to its maximum, throttle and
brake from 0 to the maximum. Vehicles whose messages need checksums, or a handshake before they obey, need an adapter
module of their own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import STATE_MAX_AGE_S, Vehicle, VehicleUnreachable

NEEDS = ("can", "cantools")
EXAMPLE_DBC = Path(__file__).parents[1] / "examples" / "example.dbc"
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "kph": 1 / 3.6, "kmh": 1 / 3.6, "mph": 0.44704, "": 1.0}
"""Units of speed signals, in m/s."""
REOPEN_DELAY_S, SILENCE_MAX_S = 1.0, 1.0
"""Delay before a bus is opened again; silence of the vehicle after which it is reported as a fault, seconds."""
MESSAGES_PER_READ_MAX = 200
"""Maximum number of messages read at once: more than any bus carries in ten milliseconds."""
FULL_CONTROLS = Controls(1.0, 1.0, 1.0, Gear.FORWARD, horn=True, lights=True)
Signal = Annotated[str, Field(max_length=200)]


class Params(step.Params):
    """Settings of a vehicle with a CAN bus; signals are named MESSAGE.SIGNAL, "" if the vehicle has no such signal."""

    dbc: Annotated[File, Field(description="DBC file that describes the vehicle's messages.")] = EXAMPLE_DBC
    interface: Annotated[str, Field(description="Interface of the bus, by its name in python-can.")] = "socketcan"
    channel: Annotated[str, Field(description="Channel of the interface: the bus.")] = "can0"
    bitrate: Annotated[
        int, Field(ge=0, le=10**8, description="Bit rate of the bus, bit/s; 0: as configured in the system.")
    ] = 0
    steering: Annotated[
        Signal,
        Field(description="Steering signal; its minimum is full right. -MESSAGE.SIGNAL: its minimum is full left."),
    ] = "DriveCommand.Steering"
    throttle: Signal = "DriveCommand.Throttle"
    brake: Signal = "DriveCommand.Brake"
    gear: Signal = "DriveCommand.Gear"
    horn: Signal = "BodyCommand.Horn"
    lights: Signal = "BodyCommand.Lights"
    counter: Annotated[Signal, Field(description="Signal that counts the messages sent.")] = "DriveCommand.Counter"
    speed: Annotated[Signal, Field(description="Signal of the vehicle's speed, in its unit in the DBC file.")] = (
        "Motion.Speed"
    )
    gear_in: Annotated[
        Signal, Field(description="Signal of the engaged gear; if empty, the requested gear is reported.")
    ] = "Motion.GearIn"
    gears: Annotated[
        tuple[str, str, str], Field(description="Names of the gear signal's values for reverse, neutral and forward.")
    ] = ("Reverse", "Neutral", "Forward")


def connect(params: Params) -> Vehicle:
    """See `adapters.VehicleAdapter`."""
    return CanVehicle(params)


class CanVehicle:
    """See `adapters.Vehicle`.

    Raises:
        InputError: the DBC file can't be read, or a configured message or signal is missing.
        SettingError: python-can doesn't have this interface.
    """

    def __init__(self, params: Params, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._params, self._clock = params, clock
        self._signals = Signals(params)
        self._bus: Any = None
        self._last_attempt, self._count = 0.0, 0
        self._speed, self._gear, self._last_received = 0.0, Gear.NEUTRAL, clock()
        self._speed_received = -math.inf
        self._open()

    def obey(self, controls: Controls) -> None:
        """Send all messages, and read those of the vehicle."""
        import can

        if self._bus is None and (self._clock() - self._last_attempt < REOPEN_DELAY_S or not self._open()):
            raise VehicleUnreachable(self._unavailable())
        self._count += 1
        try:
            for message, data in self._signals.messages(controls, self._count):
                self._bus.send(
                    can.Message(arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, data=data)
                )
            self._read_messages()
        except (can.CanError, OSError) as error:
            self._close_bus()
            raise VehicleUnreachable(f"{self._unavailable()} ({error})") from None
        if "gear_in" not in self._signals.reported:
            self._gear = controls.gear

    def state(self) -> VehicleState:
        """Reported speed and gear, if the vehicle has signals for them."""
        now = self._clock()
        silent = self._signals.reported and now - self._last_received > SILENCE_MAX_S
        faults = (f"no messages from the vehicle on {self._params.channel}",) if silent else ()
        if self._bus is None:
            faults = (self._unavailable(),)
        speed = self._speed if now - self._speed_received <= STATE_MAX_AGE_S else None
        return VehicleState(speed, gear=self._gear, faults=faults)

    def close(self) -> None:
        """Close the bus."""
        self._close_bus()

    def _unavailable(self) -> str:
        return f"the CAN bus {self._params.channel} is not available"

    def _open(self) -> bool:
        import can

        self._last_attempt = self._clock()
        options: dict[str, Any] = {"bitrate": self._params.bitrate} if self._params.bitrate else {}
        try:
            self._bus = can.Bus(self._params.channel, interface=self._params.interface, **options)
        except (can.CanInterfaceNotImplementedError, ValueError, TypeError, ImportError) as error:
            where = f"interface={self._params.interface}"
            remedy = "Choose an interface that python-can supports, such as socketcan"
            raise SettingError(where, f"can't be used ({error})", remedy) from None
        except (can.CanError, OSError):
            return False
        return True

    def _close_bus(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def _read_messages(self) -> None:
        for _ in range(MESSAGES_PER_READ_MAX):
            message = self._bus.recv(timeout=0)
            if message is None:
                return
            values = self._signals.read(message)
            if values:
                self._last_received = self._clock()
            if "speed" in values:
                self._speed, self._speed_received = values["speed"], self._last_received
            self._gear = Gear(int(values.get("gear_in", self._gear)))


class Signals:
    """Messages of a DBC file, by the names of the controls.

    Attributes:
        reported: message and signal of what the vehicle reports: "speed", "gear_in".

    Raises:
        InputError: the file can't be read, or a configured message or signal is missing.
    """

    def __init__(self, params: Params) -> None:
        import cantools

        self._path = params.dbc
        try:
            self._file: Any = cantools.database.load_file(params.dbc, "dbc", strict=True)
        except OSError as error:
            raise InputError(params.dbc, str(error.strerror), "Give the vehicle's DBC file by --set dbc=FILE") from None
        except (cantools.Error, ValueError) as error:
            raise InputError(
                params.dbc, f"is not a DBC file ({str(error)[:200]})", "Check it in a DBC editor"
            ) from None
        self._steering_inverted = params.steering.startswith("-")
        names = {
            name: str(getattr(params, name)) for name in ("throttle", "brake", "gear", "horn", "lights", "counter")
        }
        names["steering"] = params.steering.removeprefix("-")
        self._signals_by_control = {
            name: self._find(name, qualified_name) for name, qualified_name in names.items() if qualified_name
        }
        for required in ("steering", "throttle", "brake"):
            if required not in self._signals_by_control:
                raise SettingError(required, "is empty, but is needed to drive a vehicle", "Give MESSAGE.SIGNAL")
            self._range(required)
        self._gears = (
            self._values(self._signals_by_control["gear"], params.gears) if "gear" in self._signals_by_control else {}
        )
        messages = {message.frame_id: message for message, _ in self._signals_by_control.values()}
        for message in messages.values():
            if message.is_multiplexed():
                raise InputError(self._path, f"{message.name} is multiplexed", "Write an adapter for this vehicle")
        self._default_values = {key: self._defaults(message) for key, message in messages.items()}
        self._messages = list(messages.values())
        reported = {"speed": params.speed, "gear_in": params.gear_in}
        self.reported = {
            name: self._find(name, qualified_name) for name, qualified_name in reported.items() if qualified_name
        }
        if "speed" in self.reported and (unit := self.reported["speed"][1].unit or "") not in SPEED_UNITS:
            known = ", ".join(filter(None, SPEED_UNITS))
            raise InputError(self._path, f"{params.speed} has the unit {unit!r}", f"Use one of these units: {known}")
        self._gears_in = {}
        if "gear_in" in self.reported:
            self._gears_in = {
                number: gear for gear, number in self._values(self.reported["gear_in"], params.gears).items()
            }
        for controls in (FULL_CONTROLS, replace(FULL_CONTROLS, steering=-1.0, gear=Gear.REVERSE), STOP):
            self.messages(controls, 0)

    def messages(self, controls: Controls, count: int) -> list[tuple[Any, bytes]]:
        """Messages with these controls, and their bytes."""
        requested: dict[str, float] = {
            "throttle": controls.throttle * self._range("throttle")[1],
            "brake": controls.brake * self._range("brake")[1],
            "horn": controls.horn,
            "lights": controls.lights,
        }
        least, greatest = self._range("steering")
        steering = -controls.steering if self._steering_inverted else controls.steering
        requested["steering"] = steering * greatest if steering > 0 else -steering * least
        if "gear" in self._signals_by_control:
            requested["gear"] = self._gears[controls.gear]
        if "counter" in self._signals_by_control:
            requested["counter"] = count % 2 ** self._signals_by_control["counter"][1].length
        values = {key: dict(values) for key, values in self._default_values.items()}
        for name, (message, signal) in self._signals_by_control.items():
            values[message.frame_id][signal.name] = requested[name]
        return [(message, self._encode(message, values[message.frame_id])) for message in self._messages]

    def _encode(self, message: Any, values: dict[str, float]) -> bytes:
        import cantools

        try:
            return bytes(message.encode(values))
        except (cantools.Error, ValueError, OverflowError) as error:
            raise InputError(
                self._path, f"{message.name} can't be encoded ({error})", "Check its signals' ranges"
            ) from None

    def read(self, message: Any) -> dict[str, float]:
        """Decode a message of the vehicle: "speed" in m/s, "gear_in"."""
        import cantools

        values: dict[str, float] = {}
        for name, (described, signal) in self.reported.items():
            if message.arbitration_id != described.frame_id:
                continue
            try:
                value = float(described.decode(message.data, decode_choices=False)[signal.name])
            except (cantools.Error, ValueError, KeyError):  # truncated message
                continue
            if name == "speed":
                values[name] = value * SPEED_UNITS[signal.unit or ""]
            elif value in self._gears_in:
                values[name] = self._gears_in[int(value)]
        return values

    def _find(self, name: str, qualified_name: str) -> tuple[Any, Any]:
        message, _, signal_name = qualified_name.partition(".")
        known = {one.name: one for one in self._file.messages}
        remedy = f"Set it by --set {name}=MESSAGE.SIGNAL"
        if message not in known:
            raise InputError(
                self._path, f"has no message {message!r} for {name}", f"{remedy}; the file has {_list_some(known)}"
            )
        signals = {one.name: one for one in known[message].signals}
        if signal_name not in signals:
            cause = f"{message} has no signal {signal_name!r} for {name}"
            raise InputError(self._path, cause, f"{remedy}; {message} has {_list_some(signals)}")
        return known[message], signals[signal_name]

    def _range(self, name: str) -> tuple[float, float]:
        """Minimum and maximum of a signal."""
        message, signal = self._signals_by_control[name]
        if not signal.maximum or (name == "steering" and not signal.minimum):  # None or 0: the file has no range
            cause = f"{message.name}.{signal.name} has no range, which is needed to scale {name}"
            raise InputError(self._path, cause, "Add its range to the file, such as [-0.6|0.6]")
        return float(signal.minimum or 0), float(signal.maximum)

    def _values(self, found: tuple[Any, Any], names: tuple[str, str, str]) -> dict[Gear, int]:
        """Raw values of a gear signal, by gear."""
        message, signal = found
        values = {str(text): number for number, text in (signal.choices or {}).items()}
        missing = [name for name in names if name not in values]
        if missing:
            cause = f"{message.name}.{signal.name} has no value called {missing[0]!r}"
            raise InputError(self._path, cause, f'Set them by --set gears=["R","N","F"]; it has {_list_some(values)}')
        return dict(zip((Gear.REVERSE, Gear.NEUTRAL, Gear.FORWARD), (values[name] for name in names), strict=True))

    @staticmethod
    def _defaults(message: Any) -> dict[str, float]:
        """Values of signals that no control is mapped to: the initial value in the file, else 0 or the nearest."""
        return {
            one.name: one.initial if one.initial is not None else max(one.minimum or 0, min(0, one.maximum or 0))
            for one in message.signals
        }


def _list_some(names: Mapping[str, Any]) -> str:
    listed = sorted(names)
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
