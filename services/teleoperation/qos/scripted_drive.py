"""The two processes of a scripted drive: a vehicle, and a station together with its gateway.

Run as `python -m scan2sim.services.teleoperation.qos.scripted_drive vehicle|station SETUP`, where SETUP is JSON. The
process prints the port of its gateway, then answers each request that it reads with a line of JSON. Times are
nanoseconds of the monotonic clock, which both processes share on one machine: delays don't depend on clock sync.
"""

from __future__ import annotations

import json
import math
import queue
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation import adapter_key, cameras, timecode
from scan2sim.services.teleoperation.cameras import Camera, View
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Kind, Message, Telemetry
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS
from scan2sim.services.teleoperation.encoders import Decoder
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.gateway_protocol import Address
from scan2sim.services.teleoperation.identity import Identity, Peer
from scan2sim.services.teleoperation.qos import route
from scan2sim.services.teleoperation.qos.route import LoopingVehicle, PurePursuit
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.sim.bicycle import STEP_MAX_S, Bicycle, Ground
from scan2sim.services.teleoperation.station.app import JoinedVehicle, Station
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection, Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.app import Vehicle
from scan2sim.services.teleoperation.vehicle.onboard_unit import Connect, OnboardUnit, VideoSender
from scan2sim.services.teleoperation.video.jitter_buffer import Frame
from scan2sim.services.teleoperation.video.rate_control import BitrateBounds

T = TypeVar("T")
WIDTH, HEIGHT = 640, 480
DRIVER_NAME, COMMAND_PERIOD_S = "script", 0.02
"""Name of the driver, and interval between two commands."""
TARGET_SPEED_MPS, STEERING_AMPLITUDE, STEERING_PERIOD_S = 5.0, 0.3, 12.0
"""Speed of the scripted drive; amplitude of steering on a plain (1: full), and its period."""
CONFIRM_DELAY_S = 0.1
"""Delay from a stop to its confirmation."""
JOIN_TIMEOUT_S = 30.0
"""Timeout for joining and for starting to drive."""
DECODE_QUEUE_MAX_FRAMES = 60
"""Frames of a camera that may wait for decoding; more are dropped, and counted as `unseen`."""


@dataclass(frozen=True)
class Setup:
    """Setup of one of the processes.

    Attributes:
        folder: of its certificate; for the station, of all parties.
        host: address that station and gateway listen on; for the vehicle, its gateway.
        port: of the gateway; 0 at the station: any free one.
        links: of the vehicle, NAME=ADDRESS or NAME=INTERFACE.
        cameras, rate, bitrate: number of cameras; frames/s and bit/s of each.
        share: send each video packet over one link in turn.
        pictures: folder of camera images; "": the test pattern.
        limit: maximum age of a command, ms; see `safety`.
        world: folder of a finished world to drive in (`route`); "": driving in bends on a plain.
    """

    folder: str
    host: str
    port: int = 0
    links: tuple[str, ...] = ()
    cameras: int = 4
    rate: float = 30.0
    bitrate: float = 2.5e6
    share: bool = False
    pictures: str = ""
    limit: float = COMMAND_MAX_AGE_MS
    world: str = ""

    def street(self) -> tuple[Ground, F64]:
        """The ground that the car stands on, and the reference path along the street."""
        scene = read_scene(Path(self.world))
        ground = Ground(scene)
        return ground, route.reference_path(scene, ground)


def now_ns() -> int:
    """Time of the monotonic clock, nanoseconds."""
    return time.monotonic_ns()


class PlainCar:
    """A car on an infinite plain; see `adapters.Vehicle`."""

    def __init__(self) -> None:
        self.bicycle = Bicycle()
        self._last = time.monotonic()

    def obey(self, controls: Controls) -> None:
        """Apply the controls up to the present time."""
        last, self._last = self._last, time.monotonic()
        remaining = min(self._last - last, 1.0)
        while remaining > 1e-9:
            self.bicycle.step(controls, min(remaining, STEP_MAX_S))
            remaining -= STEP_MAX_S

    def state(self) -> VehicleState:
        """Current state."""
        one = self.bicycle
        return VehicleState(one.speed, (one.x, one.y), one.heading, one.gear)

    def close(self) -> None:
        """Nothing to close."""


class MessageRecorder:
    """Records messages: kind, number, time sent, time received. Thread-safe."""

    def __init__(self) -> None:
        self._messages: list[tuple[Message, int]] = []

    def recording(self, received: Callable[[Message], None]) -> Callable[[Message], None]:
        """Wrap a message callback so that its messages are recorded."""

        def record(message: Message) -> None:
            self._messages.append((message, now_ns()))
            received(message)

        return record

    def begin(self) -> None:
        """Discard all recorded messages."""
        self._messages = []

    def times(self) -> list[tuple[int, int, int, int]]:
        """Kind, number, time sent, time received; in order of arrival."""
        return [(one.kind, one.number, one.sent, arrived) for one, arrived in self._messages]

    def of_kind(self, kind: Kind) -> list[tuple[Message, int]]:
        """Messages of one kind, with their times of arrival."""
        return [one for one in self._messages if one[0].kind == kind]


class RecordingOnboardUnit(OnboardUnit):
    """An onboard unit that records the messages it receives."""

    def __init__(self, params: OnboardParams, recorder: MessageRecorder) -> None:
        super().__init__(params)
        self._recorder = recorder
        self.connection: Any = None

    def join(self, connect: Connect, cameras: Callable[[Any], Sequence[VideoSender]] = lambda _: ()) -> Any:
        """See `OnboardUnit`."""
        self.connection = super().join(
            lambda received, restarted: connect(self._recorder.recording(received), restarted), cameras
        )
        return self.connection


class RecordingListener(Listener):
    """A station's listener that records the messages it receives."""

    recorder: MessageRecorder

    def expect(
        self,
        peer: Peer,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None] = lambda packet, link: None,
        restarted: Callable[[], None] = lambda: None,
        *,
        clocks: ClockSync | None = None,
    ) -> MultipathConnection:
        """See `Listener`."""
        return super().expect(peer, self.recorder.recording(received), media, restarted, clocks=clocks)


class GlassToGlassMeter:
    """Decodes frames, in one thread per camera, and reads their drawn timecodes.

    Attributes:
        times: camera, time in the frame, time of decoding; counts: `bytes`, and frames that were `unreadable`, or
            `unseen` (dropped since too many were waiting).
    """

    def __init__(self, count: int) -> None:
        self.counts: Counter[str] = Counter()
        self.times: list[tuple[int, int, int]] = []
        self._queues = [queue.Queue[Frame](DECODE_QUEUE_MAX_FRAMES) for _ in range(count)]
        for camera in range(count):
            threading.Thread(target=self._run, args=(camera,), name=f"glass {camera}", daemon=True).start()

    def show(self, frame: Frame) -> None:
        """Queue a frame; returns at once."""
        self.counts["bytes"] += len(frame.data)
        try:
            self._queues[frame.camera].put_nowait(frame)
        except queue.Full:
            self.counts["unseen"] += 1

    def begin(self) -> None:
        """Discard all results."""
        self.times, self.counts = [], Counter()

    def _run(self, camera: int) -> None:
        decoder = Decoder()
        while True:
            frame = self._queues[camera].get()
            image = decoder.decode(frame.data)
            captured = None if image is None else timecode.read(image, frame.captured, WIDTH)
            if captured is None:
                self.counts["unreadable"] += 1
            else:
                self.times.append((camera, captured, now_ns()))


Steering = Callable[[VehicleState, float], float]
"""Steering, -1 (full right) to 1 (full left), from the vehicle's reported state and the time in seconds."""


def weave(vehicle: VehicleState, seconds: float) -> float:
    """Steer left and right periodically, regardless of the position."""
    return STEERING_AMPLITUDE * math.sin(math.tau * seconds / STEERING_PERIOD_S)


class ScriptedCommands:
    """Commands of the scripted driver: constant speed, and steering; confirms stops after a delay."""

    def __init__(self, steering: Steering = weave) -> None:
        self._steering = steering
        self._stop, self._since = -1, 0.0

    def command(self, telemetry: Telemetry, seconds: float) -> Command:
        """Command at a time in seconds, from the vehicle's last telemetry."""
        if telemetry.stop != self._stop:
            self._stop, self._since = telemetry.stop, seconds
        if telemetry.standing:
            return Command(Controls(gear=Gear.FORWARD), telemetry.stop, seconds > self._since + CONFIRM_DELAY_S)
        speed_error = TARGET_SPEED_MPS - (telemetry.vehicle.speed or 0.0)
        controls = Controls(
            steering=self._steering(telemetry.vehicle, seconds),
            throttle=min(max(0.5 * speed_error, 0.0), 1.0),
            brake=min(max(-0.2 * speed_error, 0.0), 0.5),
            gear=Gear.FORWARD,
        )
        return Command(controls, telemetry.stop)


class ScriptedDriver(threading.Thread):
    """Thread that drives a station's vehicle."""

    def __init__(self, station: Station, steering: Steering) -> None:
        super().__init__(name="driver", daemon=True)
        self._station, self._commands, self._ended = station, ScriptedCommands(steering), threading.Event()

    def run(self) -> None:
        """Drive until `close`."""
        self._station.driver_session.acquire(DRIVER_NAME, time.monotonic())
        while not self._ended.wait(COMMAND_PERIOD_S):
            joined, seconds = self._station.joined(), time.monotonic()
            if joined is not None and joined.telemetry is not None:
                command = self._commands.command(joined.telemetry, seconds)
                self._station.driver_session.update(DRIVER_NAME, command, seconds)

    def close(self) -> None:
        """Stop driving, and release the control lock."""
        self._ended.set()
        self.join()
        self._station.driver_session.release(DRIVER_NAME, "the scripted drive has ended")


class VehicleEnd:
    """The vehicle process: a vehicle on a plain or in a world, its adapter and its cameras."""

    def __init__(self, setup: Setup) -> None:
        identity, recorder, ended = Identity.read(Path(setup.folder)), MessageRecorder(), threading.Event()
        self._looping_vehicle: LoopingVehicle | None = None
        if setup.world:
            ground, self._path = setup.street()
            self._looping_vehicle = LoopingVehicle(ground, self._path)
        key = adapter_key.create(Path(setup.folder) / adapter_key.ADAPTER_KEY_FILE)
        params = AdapterParams(port=0, limit=setup.limit, key=key)
        adapter_server = AdapterServer(self._looping_vehicle or PlainCar(), params)
        threading.Thread(target=adapter_server.run, args=(ended,), name="adapter", daemon=True).start()
        host, port = adapter_server.address
        self._unit = RecordingOnboardUnit(OnboardParams(adapter=f"{host}:{port}", limit=setup.limit, key=key), recorder)
        self._recorder = recorder
        links = [Link(*text.split("=", 1)) for text in setup.links]
        bounds = BitrateBounds(highest=round(setup.bitrate))
        policy = Policy.SHARE if setup.share else Policy.COPY
        self._vehicle = Vehicle(identity, self._unit, links, _cameras(setup), policy, bounds)
        GatewayConnection(identity, Address(host=setup.host, port=setup.port), self._vehicle, _say)

    def begin(self) -> bool:
        """Start recording."""
        self._recorder.begin()
        if self._looping_vehicle is not None:
            self._looping_vehicle.begin()
        return True

    def results(self) -> dict[str, Any]:
        """Received messages, dropped commands and faults; reference path and driven positions."""
        connection, safety = self._unit.connection, self._unit.car.safety
        return {
            "messages": self._recorder.times(),
            "counts": {} if connection is None else dict(connection.counts),
            "dropped": dict(safety.dropped),
            "stop": safety.stop,
            "faults": self._unit.car.telemetry(now_ns()).vehicle.faults,
            "way": [] if self._looping_vehicle is None else self._path.tolist(),
            "driven": [] if self._looping_vehicle is None else list(self._looping_vehicle.positions),
            "runs": 0 if self._looping_vehicle is None else self._looping_vehicle.runs,
        }


class StationEnd:
    """The station process: a station with a scripted driver, and a gateway."""

    def __init__(self, setup: Setup) -> None:
        parties = Path(setup.folder)
        gate = Identity.read(parties / "gateway")
        (desk,) = (Identity.read(one) for one in parties.glob("station-*"))
        (self._name,) = (one.name.removeprefix("vehicle-") for one in parties.glob("vehicle-*"))
        self._desk = desk.me.name
        self._fleet = Fleet(parties / "state")
        self.gateway = Gateway(gate, setup.host, 0, self._fleet, _say)
        self._listener = RecordingListener(desk, [(setup.host, 0)])
        self._listener.recorder = self._recorder = MessageRecorder()
        self._meter, self._setup = GlassToGlassMeter(max(setup.cameras, 1)), setup
        reached = [Address(host=host, port=port) for host, port in self._listener.addresses]
        self._station = Station(desk, self._listener, reached, self._meter.show)
        self._script: ScriptedDriver | None = None
        self._steering = _path_steering(setup) if setup.world else weave
        self._frames_before: dict[int, Counter[str]] = {}
        GatewayConnection(desk, Address(host=setup.host, port=self.gateway.port), self._station, _say)

    def join(self) -> dict[str, Any]:
        """Join vehicle and station, and wait until video and all links work; returns how long each took, seconds."""
        _until(self._both_connected, "the vehicle to connect")
        self._meter.begin()
        started = time.monotonic()
        self._fleet.join(self._name, self._desk, DRIVER_NAME)
        joined = _until(self._station.joined, "the order to join")
        _until(lambda: not joined.blocked_by(), "a link and clock sync")
        first = time.monotonic() - started
        _until(lambda: len({one[0] for one in list(self._meter.times)}) == self._setup.cameras, "video of all cameras")
        pictures = time.monotonic() - started
        _until(lambda: joined.connection.links != () and all(one.up for one in joined.connection.links), "all links")
        return {
            "ready_s": first,
            "pictures_s": pictures,
            "handshakes_s": [one.handshake_s for one in joined.connection.links],
            "ciphers": sorted({one.cipher for one in joined.connection.links}),
        }

    def release(self) -> bool:
        """Release the vehicle."""
        if self._script is not None:
            self._script.close()
            self._script = None
        self._fleet.release(self._name, DRIVER_NAME)
        _until(lambda: self._station.joined() is None, "the order to release")
        return True

    def drive(self) -> bool:
        """Start driving."""
        self._script = ScriptedDriver(self._station, self._steering)
        self._script.start()
        _until(
            lambda: (telemetry := self._joined().telemetry) is not None and not telemetry.standing,
            "the vehicle to drive",
        )
        return True

    def begin(self) -> bool:
        """Start recording."""
        self._recorder.begin()
        self._meter.begin()
        self._frames_before = self._joined().receiver.frames()
        return True

    def results(self) -> dict[str, Any]:
        """Received messages and frames, and the state of the links."""
        joined = self._joined()
        frames: Counter[str] = Counter()
        for camera, counts in joined.receiver.frames().items():
            frames.update(counts)
            frames.subtract(self._frames_before.get(camera, Counter()))
        telemetries = [(Telemetry.unpack(one.body), arrived) for one, arrived in self._recorder.of_kind(Kind.TELEMETRY)]
        return {
            "messages": self._recorder.times(),
            "obeyed": [(one.command, arrived) for one, arrived in telemetries],
            "stops": sorted({one.stop for one, _ in telemetries}),
            "reasons": sorted({one.reason for one, _ in telemetries if one.standing}),
            "frames": dict(frames),
            "glass": list(self._meter.times),
            "seen": dict(self._meter.counts),
            "counts": dict(joined.connection.counts),
            "packets": dict(joined.receiver.counts),
            "links": [asdict(one) for one in joined.connection.links],
        }

    def _both_connected(self) -> bool:
        fleet = self._fleet.snapshot()
        return all(any(one["connected"] for one in fleet[kind]) for kind in ("vehicles", "stations"))

    def _joined(self) -> JoinedVehicle:
        return _until(self._station.joined, "a vehicle")


def _path_steering(setup: Setup) -> Steering:
    ground, path = setup.street()
    pursuit = PurePursuit(path, ground.car)
    return lambda vehicle, seconds: pursuit.steering(vehicle)


def _cameras(setup: Setup) -> dict[str, Camera]:
    kind = "replay" if setup.pictures else "pattern"
    view = View(setup.pictures, WIDTH, HEIGHT, setup.rate, draw_timecode=True)

    def camera(number: int) -> Camera:
        return Camera(f"camera {number}", lambda: cameras.frames(kind, view))

    return {f"camera {number}": camera(number) for number in range(setup.cameras)}


def _until(condition: Callable[[], T | None], what: str) -> T:
    end = time.monotonic() + JOIN_TIMEOUT_S
    while (found := condition()) is None or found is False:
        if time.monotonic() > end:
            cause = f"waited {JOIN_TIMEOUT_S:g} s for {what}"
            raise StepError("the scripted drive", cause, "Use a network with less loss and delay")
        time.sleep(0.005)
    return found


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main() -> None:
    """Run one of the processes until its standard input ends."""
    setup = Setup(**json.loads(sys.argv[2]))
    end: VehicleEnd | StationEnd = VehicleEnd(setup) if sys.argv[1] == "vehicle" else StationEnd(setup)
    print(json.dumps(end.gateway.port if isinstance(end, StationEnd) else 0), flush=True)
    for request in sys.stdin:
        print(json.dumps(getattr(end, request.strip())()), flush=True)


if __name__ == "__main__":
    main()
