"""A gateway, a station and a vehicle on this machine, set up as by their commands, and a scripted driver."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from scan2sim.services.teleoperation import cameras
from scan2sim.services.teleoperation.cameras import Camera, CameraFrame, View
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command, VideoStream
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.gateway_protocol import Address
from scan2sim.services.teleoperation.identity import Identity
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.station.app import Station
from scan2sim.services.teleoperation.transport.multipath import Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.app import Vehicle
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardUnit
from scan2sim.services.teleoperation.video.jitter_buffer import Frame
from scan2sim.services.teleoperation.video.rate_control import BitrateBounds
from tests.fakes.relay import Relay
from tests.fakes.vehicle import RecordingVehicle, adapter_key_file
from tests.waiting import until

HERE = "127.0.0.1"
LIMIT = 5000.0
"""Milliseconds; the maximum, so that a stalled thread of a busy machine doesn't stop the vehicle."""
SCRIPT = "script"
AHEAD = Controls(throttle=0.5, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)


class Desk:
    """A station, set up as by `teleop station`; `frames` are the frames it received.

    Attributes:
        shape: properties of its links, if `relayed`.
    """

    def __init__(self, folder: Path, gateway: int, port: int = 0, relayed: bool = False) -> None:
        self.frames: list[Frame] = []
        self.show: Callable[[Frame], None] = self.frames.append
        identity = Identity.read(folder)
        self._listener = Listener(identity, [(HERE, port)])
        self.port = self._listener.port
        self._relay = Relay((HERE, self.port))
        self.shape = self._relay.shapes[HERE]
        reached = [Address(host=HERE, port=self._relay.address[1] if relayed else self.port)]
        self.station = Station(identity, self._listener, reached, lambda frame: self.show(frame))
        self.gateway_connection = GatewayConnection(
            identity, Address(host=HERE, port=gateway), self.station, lambda _: None
        )
        self._command: Callable[[], Command | None] = lambda: None
        self._ended = threading.Event()
        self._driver = threading.Thread(target=self._drive, daemon=True)
        self._driver.start()

    def drive(self, controls: Controls | None, agree: bool = False) -> None:
        """Send these controls from now on; None: none."""
        if controls is None:
            self._command = lambda: None
            return
        self.station.driver_session.acquire(SCRIPT, time.monotonic())
        self._command = lambda: Command(controls, self.stop(), agree)

    def start(self) -> None:
        """Confirm the stop as a driver does, and drive ahead."""
        self.drive(REST)
        until(lambda: self.telemetry() is not None and not self.blocked_by())
        until(self._confirm)
        self.drive(AHEAD)

    def _confirm(self) -> bool:
        """See the stop, then agree; whether the vehicle has left it. Repeated, since commands may arrive too late."""
        for agree in (False, True):
            self.drive(REST, agree)
            end = time.monotonic() + 0.2
            while self.standing() and time.monotonic() < end:
                time.sleep(0.01)
        return not self.standing()

    def telemetry(self) -> object:
        joined = self.station.joined()
        return None if joined is None else joined.telemetry

    def streams(self) -> tuple[VideoStream, ...]:
        joined = self.station.joined()
        return () if joined is None else joined.streams.cameras

    def stop(self) -> int:
        joined = self.station.joined()
        return 0 if joined is None or joined.telemetry is None else joined.telemetry.stop

    def standing(self) -> bool:
        joined = self.station.joined()
        return joined is None or joined.telemetry is None or joined.telemetry.standing

    def blocked_by(self) -> str:
        joined = self.station.joined()
        return "" if joined is None else joined.blocked_by()

    def close(self) -> None:
        self._ended.set()
        self._driver.join()
        self.gateway_connection.close()
        self.station.close()
        self._listener.close()
        self._relay.close()

    def _drive(self) -> None:
        while not self._ended.wait(0.02):
            if (command := self._command()) is not None:
                self.station.driver_session.update(SCRIPT, command, time.monotonic())


class Street:
    """Gateway and vehicle; `desks` are created by the tests."""

    def __init__(self, folder: Path) -> None:
        self.parties = folder / "parties"
        certify(self.parties, [HERE], ["car"], ["desk", "other"], 1, False)
        self._state = folder / "state"
        self.gateway, self.fleet = self._start(0)
        self.car, self._ended = RecordingVehicle(), threading.Event()
        adapter_server = AdapterServer(self.car, AdapterParams(port=0, limit=LIMIT, key=adapter_key_file()))
        self._adapter_thread = threading.Thread(target=adapter_server.run, args=(self._ended,), daemon=True)
        self._adapter_thread.start()
        address = f"{HERE}:{adapter_server.address[1]}"
        unit = OnboardUnit(OnboardParams(adapter=address, limit=LIMIT, key=adapter_key_file()))
        self.size = 160, 120
        front = Camera("front", self._frames)
        links = [Link("one", HERE), Link("two", HERE)]
        identity = Identity.read(self.parties / "vehicle-car")
        self.vehicle = Vehicle(identity, unit, links, {"front": front}, Policy.COPY, BitrateBounds())
        self._gateway_connection = GatewayConnection(
            identity, Address(host=HERE, port=self.gateway.port), self.vehicle, lambda _: None
        )
        self.desks: list[Desk] = []

    def _frames(self) -> Iterator[CameraFrame]:
        """Frames of a camera, in the current `size`."""
        for one in cameras.frames("pattern", View(width=160, height=120, fps=10)):
            yield CameraFrame(np.ascontiguousarray(cv2.resize(one.image, self.size), np.uint8), one.captured)

    def desk(self, name: str = "desk", port: int = 0, relayed: bool = False) -> Desk:
        """Start a station and wait for it; `relayed`: the test sets the properties of its links."""
        desk = Desk(self.parties / f"station-{name}", self.gateway.port, port, relayed)
        self.desks.append(desk)
        until(lambda: any(one["name"] == name and one["connected"] for one in self.fleet.snapshot()["stations"]))
        until(lambda: any(one["connected"] for one in self.fleet.snapshot()["vehicles"]))
        return desk

    def restart_gateway(self) -> None:
        port = self.gateway.port
        self.gateway.close()
        self.gateway, self.fleet = self._start(port)

    def _start(self, port: int) -> tuple[Gateway, Fleet]:
        fleet = Fleet(self._state)
        return Gateway(Identity.read(self.parties / "gateway"), HERE, port, fleet, lambda _: None), fleet

    def stop_adapter(self) -> None:
        """End the vehicle adapter, which no longer answers."""
        self._ended.set()
        self._adapter_thread.join()

    def close(self) -> None:
        for desk in self.desks:
            desk.close()
        self._gateway_connection.close()
        self.vehicle.close()
        self._ended.set()
        self._adapter_thread.join()
        self.gateway.close()
