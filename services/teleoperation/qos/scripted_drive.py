"""The two ends of a drive by a script, each a process: a vehicle, and its station with a gateway beside it.

`python -m scan2sim.services.teleoperation.qos.scripted_drive vehicle|station SETUP`, `SETUP` being JSON: an end tells
the port of
its gateway, then answers each word that it reads with a line of JSON. Times are nanoseconds of the monotonic clock,
which both ends have from one machine: delays are told by it, not by what the two take each other's clocks for.
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
from scan2sim.services.teleoperation import cameras
from scan2sim.services.teleoperation.cameras import Camera, View
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Kind, Message, Telemetry
from scan2sim.services.teleoperation.control.safety import LIMIT_MS
from scan2sim.services.teleoperation.encoders import Decoder
from scan2sim.services.teleoperation.gateway.client import Membership
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer
from scan2sim.services.teleoperation.gateway.protocol import Address
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.sim import route
from scan2sim.services.teleoperation.sim.bicycle import LONGEST_STEP, Bicycle, Ground
from scan2sim.services.teleoperation.sim.route import Driven, Pursuit
from scan2sim.services.teleoperation.station.app import Joined, Station
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.multipath import Bundle, Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link
from scan2sim.services.teleoperation.vehicle.adapter import TranslateParams, Translating
from scan2sim.services.teleoperation.vehicle.app import Vehicle
from scan2sim.services.teleoperation.vehicle.onboard_unit import CarParams, CarUnit, Dial, Sender
from scan2sim.services.teleoperation.video import timecode
from scan2sim.services.teleoperation.video.jitter_buffer import Frame
from scan2sim.services.teleoperation.video.rate_control import Bounds

T = TypeVar("T")
WIDTH, HEIGHT = 640, 480
DRIVER, EVERY = "script", 0.02
"""Who has the wheel, and seconds from one turn of it to the next."""
SPEED, BEND, ROUND = 5.0, 0.3, 12.0
"""Metres a second that are driven; how far the wheel is turned to both sides, and seconds from left to left."""
SEEN = 0.1
"""Seconds that a stop is looked at before it is confirmed."""
JOINS = 30.0
"""Seconds within which a vehicle is to be joined and to drive."""
WAITING = 60
"""Frames of a camera that may wait to be decoded; one more is left out, and counted."""


@dataclass(frozen=True)
class Setup:
    """Of an end.

    Attributes:
        folder: of its certificate; of a station, of all parties.
        host: that a station and its gateway listen on; a vehicle's gateway.
        port: of the gateway; 0 at a station: any.
        links: a vehicle's, NAME=ADDRESS or NAME=INTERFACE.
        cameras, rate, bitrate: how many, pictures a second and bit/s of each.
        share: video takes the links in turn.
        pictures: folder of what cameras show; "": the pattern.
        limit: ms, see `safety`.
        world: folder of a finished world, along whose street is driven (`route`); "": bends, on a plain.
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
    limit: float = LIMIT_MS
    world: str = ""

    def street(self) -> tuple[Ground, F64]:
        """What its car stands on, and the way along it."""
        scene = read_scene(Path(self.world))
        ground = Ground(scene)
        return ground, route.way(scene, ground)


def now() -> int:
    """Nanoseconds of the monotonic clock."""
    return time.monotonic_ns()


class Plain:
    """A car on an endless plain; see `translators.Vehicle`."""

    def __init__(self) -> None:
        self.bicycle = Bicycle()
        self._last = time.monotonic()

    def obey(self, controls: Controls) -> None:
        """Drive until now."""
        last, self._last = self._last, time.monotonic()
        left = min(self._last - last, 1.0)
        while left > 1e-9:
            self.bicycle.step(controls, min(left, LONGEST_STEP))
            left -= LONGEST_STEP

    def state(self) -> VehicleState:
        """Where it is."""
        one = self.bicycle
        return VehicleState(one.speed, (one.x, one.y), one.heading, one.gear)

    def close(self) -> None:
        """Nothing is open."""


class Heard:
    """Messages as they came: kind, number, when they were sent and when they came. Any thread's."""

    def __init__(self) -> None:
        self._messages: list[tuple[Message, int]] = []

    def hearing(self, received: Callable[[Message], None]) -> Callable[[Message], None]:
        """What takes messages, and hands them on."""

        def noted(message: Message) -> None:
            self._messages.append((message, now()))
            received(message)

        return noted

    def begin(self) -> None:
        """Forget all."""
        self._messages = []

    def times(self) -> list[tuple[int, int, int, int]]:
        """Kind, number, sent, came; in the order of their coming."""
        return [(one.kind, one.number, one.sent, came) for one, came in self._messages]

    def of(self, kind: Kind) -> list[tuple[Message, int]]:
        """Those of a kind."""
        return [one for one in self._messages if one[0].kind == kind]


class HearingUnit(CarUnit):
    """A car unit that notes what it hears."""

    def __init__(self, params: CarParams, heard: Heard) -> None:
        super().__init__(params)
        self._heard = heard
        self.bundle: Any = None

    def join(self, dial: Dial, cameras: Callable[[Any], Sequence[Sender]] = lambda _: ()) -> Any:
        """See `CarUnit`."""
        self.bundle = super().join(lambda received, began: dial(self._heard.hearing(received), began), cameras)
        return self.bundle


class HearingListener(Listener):
    """A station's listener that notes what it hears."""

    heard: Heard

    def expect(
        self,
        peer: Peer,
        received: Callable[[Message], None],
        media: Callable[[bytes, str], None] = lambda packet, link: None,
        began: Callable[[], None] = lambda: None,
        *,
        clocks: Clocks | None = None,
    ) -> Bundle:
        """See `Listener`."""
        return super().expect(peer, self.heard.hearing(received), media, began, clocks=clocks)


class Glass:
    """Decodes frames, a thread a camera, and reads the time that is drawn into them.

    Attributes:
        times: camera, time in the picture, when it was decoded; counts: `bytes`, and frames that were `unreadable`,
            or `unseen`, as too many waited.
    """

    def __init__(self, count: int) -> None:
        self.counts: Counter[str] = Counter()
        self.times: list[tuple[int, int, int]] = []
        self._waiting = [queue.Queue[Frame](WAITING) for _ in range(count)]
        for camera in range(count):
            threading.Thread(target=self._run, args=(camera,), name=f"glass {camera}", daemon=True).start()

    def show(self, frame: Frame) -> None:
        """Take a frame; returns at once."""
        self.counts["bytes"] += len(frame.data)
        try:
            self._waiting[frame.camera].put_nowait(frame)
        except queue.Full:
            self.counts["unseen"] += 1

    def begin(self) -> None:
        """Forget all."""
        self.times, self.counts = [], Counter()

    def _run(self, camera: int) -> None:
        decoder = Decoder()
        while True:
            frame = self._waiting[camera].get()
            picture = decoder.decode(frame.data)
            drawn = None if picture is None else timecode.read(picture, frame.captured, WIDTH)
            if drawn is None:
                self.counts["unreadable"] += 1
            else:
                self.times.append((camera, drawn, now()))


Steering = Callable[[VehicleState, float], float]
"""Of a vehicle that tells so, at a moment (seconds): -1 (full right) to 1 (full left)."""


def bends(vehicle: VehicleState, seconds: float) -> float:
    """To both sides in turn, wherever it is."""
    return BEND * math.sin(math.tau * seconds / ROUND)


class Route:
    """What a script asks for: a steady speed, and steering; it confirms stops once it has seen them."""

    def __init__(self, steering: Steering = bends) -> None:
        self._steering = steering
        self._stop, self._since = -1, 0.0

    def command(self, told: Telemetry, seconds: float) -> Command:
        """At a moment, of a vehicle that tells so."""
        if told.stop != self._stop:
            self._stop, self._since = told.stop, seconds
        if told.standing:
            return Command(Controls(gear=Gear.FORWARD), told.stop, seconds > self._since + SEEN)
        lacks = SPEED - told.vehicle.speed
        controls = Controls(
            steering=self._steering(told.vehicle, seconds),
            throttle=min(max(0.5 * lacks, 0.0), 1.0),
            brake=min(max(-0.2 * lacks, 0.0), 0.5),
            gear=Gear.FORWARD,
        )
        return Command(controls, told.stop)


class Script(threading.Thread):
    """Drives a station's vehicle along a route."""

    def __init__(self, station: Station, steering: Steering) -> None:
        super().__init__(name="driver", daemon=True)
        self._station, self._route, self._ended = station, Route(steering), threading.Event()

    def run(self) -> None:
        """Until `close`."""
        self._station.wheel.take(DRIVER, time.monotonic())
        while not self._ended.wait(EVERY):
            joined, seconds = self._station.joined(), time.monotonic()
            if joined is not None and joined.telemetry is not None:
                self._station.wheel.turn(DRIVER, self._route.command(joined.telemetry, seconds), seconds)

    def close(self) -> None:
        """Let go of the wheel."""
        self._ended.set()
        self.join()
        self._station.wheel.leave(DRIVER, "the script ends")


class VehicleEnd:
    """A vehicle on a plain, or in a world, its translator and its cameras."""

    def __init__(self, setup: Setup) -> None:
        identity, heard, ended = Identity.read(Path(setup.folder)), Heard(), threading.Event()
        self._driven: Driven | None = None
        if setup.world:
            ground, self._way = setup.street()
            self._driven = Driven(ground, self._way)
        translating = Translating(self._driven or Plain(), TranslateParams(port=0, limit=setup.limit))
        threading.Thread(target=translating.run, args=(ended,), name="translating", daemon=True).start()
        host, port = translating.address
        self._unit = HearingUnit(CarParams(translator=f"{host}:{port}", limit=setup.limit), heard)
        self._heard = heard
        links = [Link(*text.split("=", 1)) for text in setup.links]
        bounds = Bounds(highest=round(setup.bitrate))
        policy = Policy.SHARE if setup.share else Policy.COPY
        self._vehicle = Vehicle(identity, self._unit, links, _cameras(setup), policy, bounds)
        Membership(identity, Address(host=setup.host, port=setup.port), self._vehicle, _say)

    def begin(self) -> bool:
        """Note from now on."""
        self._heard.begin()
        if self._driven is not None:
            self._driven.begin()
        return True

    def told(self) -> dict[str, Any]:
        """What came, and what didn't go well; where it was, and was to be."""
        bundle, safety = self._unit.bundle, self._unit.car.safety
        return {
            "messages": self._heard.times(),
            "counts": {} if bundle is None else dict(bundle.counts),
            "dropped": dict(safety.dropped),
            "stop": safety.stop,
            "faults": self._unit.car.telemetry(now()).vehicle.faults,
            "way": [] if self._driven is None else self._way.tolist(),
            "driven": [] if self._driven is None else list(self._driven.places),
            "runs": 0 if self._driven is None else self._driven.runs,
        }


class StationEnd:
    """A station with a script as its driver, and a gateway beside it."""

    def __init__(self, setup: Setup) -> None:
        parties = Path(setup.folder)
        gate = Identity.read(parties / "gateway")
        (desk,) = (Identity.read(one) for one in parties.glob("station-*"))
        (self._name,) = (one.name.removeprefix("vehicle-") for one in parties.glob("vehicle-*"))
        self._desk = desk.me.name
        self._fleet = Fleet(parties / "state")
        self.gateway = Gateway(gate, setup.host, 0, self._fleet, _say)
        self._listener = HearingListener(desk, [(setup.host, 0)])
        self._listener.heard = self._heard = Heard()
        self._glass, self._setup = Glass(max(setup.cameras, 1)), setup
        reached = [Address(host=host, port=port) for host, port in self._listener.addresses]
        self._station = Station(desk, self._listener, reached, self._glass.show)
        self._script: Script | None = None
        self._steering = _along(setup) if setup.world else bends
        self._before: dict[int, Counter[str]] = {}
        Membership(desk, Address(host=setup.host, port=self.gateway.port), self._station, _say)

    def join(self) -> dict[str, Any]:
        """Have the gateway join both, and wait until all is there; how many seconds each took."""
        _until(self._there, "a vehicle that is connected")
        self._glass.begin()
        began = time.monotonic()
        self._fleet.join(self._name, self._desk, DRIVER)
        joined = _until(self._station.joined, "the order to join")
        _until(lambda: not joined.hindrance(), "a link")
        first = time.monotonic() - began
        _until(lambda: len({one[0] for one in list(self._glass.times)}) == self._setup.cameras, "pictures")
        pictures = time.monotonic() - began
        _until(lambda: joined.bundle.links != () and all(one.up for one in joined.bundle.links), "all links")
        return {
            "ready_s": first,
            "pictures_s": pictures,
            "handshakes_s": [one.handshake_s for one in joined.bundle.links],
            "ciphers": sorted({one.cipher for one in joined.bundle.links}),
        }

    def release(self) -> bool:
        """Have the gateway part them."""
        if self._script is not None:
            self._script.close()
            self._script = None
        self._fleet.release(self._name, DRIVER)
        _until(lambda: self._station.joined() is None, "the release")
        return True

    def drive(self) -> bool:
        """Begin to drive."""
        self._script = Script(self._station, self._steering)
        self._script.start()
        _until(lambda: (told := self._joined().telemetry) is not None and not told.standing, "driving")
        return True

    def begin(self) -> bool:
        """Note from now on."""
        self._heard.begin()
        self._glass.begin()
        self._before = self._joined().watcher.frames()
        return True

    def told(self) -> dict[str, Any]:
        """What came, of messages and pictures."""
        joined = self._joined()
        frames: Counter[str] = Counter()
        for camera, counts in joined.watcher.frames().items():
            frames.update(counts)
            frames.subtract(self._before.get(camera, Counter()))
        telemetries = [(Telemetry.unpack(one.body), came) for one, came in self._heard.of(Kind.TELEMETRY)]
        return {
            "messages": self._heard.times(),
            "obeyed": [(one.command, came) for one, came in telemetries],
            "stops": sorted({one.stop for one, _ in telemetries}),
            "reasons": sorted({one.reason for one, _ in telemetries if one.standing}),
            "frames": dict(frames),
            "glass": list(self._glass.times),
            "seen": dict(self._glass.counts),
            "counts": dict(joined.bundle.counts),
            "packets": dict(joined.watcher.counts),
            "links": [asdict(one) for one in joined.bundle.links],
        }

    def _there(self) -> bool:
        told = self._fleet.facts()
        return all(any(one["there"] for one in told[kind]) for kind in ("vehicles", "stations"))

    def _joined(self) -> Joined:
        return _until(self._station.joined, "a vehicle")


def _along(setup: Setup) -> Steering:
    ground, way = setup.street()
    pursuit = Pursuit(way, ground.car)
    return lambda vehicle, seconds: pursuit.steering(vehicle)


def _cameras(setup: Setup) -> dict[str, Camera]:
    kind = "replay" if setup.pictures else "pattern"
    view = View(setup.pictures, WIDTH, HEIGHT, setup.rate, marked=True)

    def camera(number: int) -> Camera:
        return Camera(f"camera {number}", lambda: cameras.pictures(kind, view))

    return {f"camera {number}": camera(number) for number in range(setup.cameras)}


def _until(true: Callable[[], T | None], what: str) -> T:
    end = time.monotonic() + JOINS
    while (found := true()) is None or found is False:
        if time.monotonic() > end:
            raise StepError("the scripted drive", f"waits {JOINS:g} s for {what}", "Make the network less bad")
        time.sleep(0.005)
    return found


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main() -> None:
    """Be an end, until no more words come."""
    setup = Setup(**json.loads(sys.argv[2]))
    end: VehicleEnd | StationEnd = VehicleEnd(setup) if sys.argv[1] == "vehicle" else StationEnd(setup)
    print(json.dumps(end.gateway.port if isinstance(end, StationEnd) else 0), flush=True)
    for word in sys.stdin:
        print(json.dumps(getattr(end, word.strip())()), flush=True)


if __name__ == "__main__":
    main()
