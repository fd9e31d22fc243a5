"""A vehicle: its car unit, its cameras and its links, as a party of the gateway's; `serve` is the command."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from scan2sim.pipeline.core.errors import SettingError, StepError
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation import cameras, encoders
from scan2sim.services.teleoperation.cameras import Camera, Mount, View
from scan2sim.services.teleoperation.control.messages import Kind, Message, Report, Stream
from scan2sim.services.teleoperation.gateway.client import Membership
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.gateway.protocol import Driving, Hello, Join, Refused, Release, Status
from scan2sim.services.teleoperation.settings import GATEWAY, VehicleParams, address
from scan2sim.services.teleoperation.sim.bicycle import Ground, Place
from scan2sim.services.teleoperation.transport.link_stats import Rates
from scan2sim.services.teleoperation.transport.multipath import Bundle, Policy
from scan2sim.services.teleoperation.transport.vehicle_side import Link, dial
from scan2sim.services.teleoperation.vehicle.onboard_unit import CarParams, CarUnit
from scan2sim.services.teleoperation.video.capture import Coder, Streamer
from scan2sim.services.teleoperation.video.rate_control import Adapting, Bounds, Plan
from scan2sim.services.teleoperation.video.srtp_session import Keys, lasting

FASTEST = 60.0
"""Pictures a second of a camera, at most."""
TOLD = 0.5
"""Seconds between two tellings of the video's keys, which may be lost."""


class Sent:
    """A camera's video on its way to a station; see `car.Sender`."""

    def __init__(self, number: int, camera: Camera, keys: Keys, bundle: Bundle, policy: Policy, bounds: Bounds) -> None:
        """Begins at once."""
        self._coder = Coder(number, keys, encoders.find())
        self._adapting = Adapting(bounds, Plan(min(Plan().bitrate, bounds.highest)))
        self._camera, self._bundle = camera, bundle

        def sent(packets: Sequence[bytes]) -> None:
            for packet in packets:
                bundle.send_media(packet, policy)

        self._streamer = Streamer(number, camera, self._coder, sent, self._adapting.plan)

    @property
    def stream(self) -> Stream:
        """What the station is told of it."""
        return self._streamer.stream

    @property
    def fault(self) -> str:
        """Why there are no pictures; nothing: there are."""
        return self._streamer.fault or (self._camera.fault if self._camera.gone else "")

    def want_key(self) -> None:
        """Send a key frame next."""
        self._coder.want_key()

    def send_again(self, source: int, sequences: Sequence[int]) -> None:
        """Send packets again that didn't come, over all links."""
        for packet in self._coder.again(source, sequences):
            self._bundle.send_media(packet)

    def adapt(self, report: Report) -> None:
        """Follow what the links carry."""
        width, height = self._coder.size
        self._streamer.plan = self._adapting.follow(report, width, height)

    def close(self) -> None:
        """Send no more."""
        self._streamer.close()


class Vehicle:
    """A party of the gateway's (see `membership.Party`), from its making to `close`."""

    def __init__(
        self,
        identity: Identity,
        unit: CarUnit,
        links: Sequence[Link],
        cameras: Mapping[str, Camera],
        policy: Policy,
        bounds: Bounds,
    ) -> None:
        """Of a car unit that runs.

        Args:
            links: that a station is dialled over.
            cameras: by name; the first is what a driver sees largest.
            policy: of the video: over all links, or in turn.
            bounds: of each camera's bit rate.
        """
        self._identity, self._unit, self._links = identity, unit, tuple(links)
        self._cameras, self._policy, self._bounds = dict(cameras), policy, bounds
        self._lock = threading.Lock()
        self._driving: Driving | None = None
        self._bundle: Bundle | None = None
        self._sent: list[Sent] = []
        self._keys: Keys | None = None
        self._rates = Rates()
        self._ended = threading.Event()
        self._teller = threading.Thread(target=self._tell_keys, name="keys of the video", daemon=True)
        self._teller.start()

    def hello(self) -> Hello:
        """See `Party`."""
        return Hello(cameras=tuple(self._cameras), driving=self._driving)

    def status(self) -> Status:
        """See `Party`."""
        with self._lock:
            driving, bundle = self._driving, self._bundle
        if driving is None or bundle is None:
            return Status(speed=self._unit.car.vehicle().speed)
        told = self._unit.car.telemetry(time.monotonic_ns())
        reason = told.reason if told.standing else "; ".join(told.vehicle.faults)
        return Status(
            pair=driving.pair, links=self._rates.links(bundle), driving=not told.standing, told=reason[:200],
            speed=told.vehicle.speed, age=told.age,
        )  # fmt: skip

    def obey(self, order: Join | Release | Refused) -> None:
        """See `Party`."""
        if isinstance(order, Join):
            driving = Driving(pair=order.pair, other=order.other.name)
            if driving != self._driving:
                self._leave("another driver joins")
                self._join(order, driving)
        elif isinstance(order, Release):
            self._leave(order.why or "it was released")

    def alive(self) -> bool:
        """Whether its threads live."""
        return self._teller.is_alive() and self._unit.failed is None

    def close(self) -> None:
        """Leave the station; the vehicle stands."""
        self._ended.set()
        self._leave("the car unit ends")
        self._teller.join(2.0)
        self._unit.close()
        for camera in self._cameras.values():
            camera.close()

    def _join(self, order: Join, driving: Driving) -> None:
        station = Peer(Role.STATION, order.other.name, order.other.fingerprint)
        addresses = [(one.host, one.port) for one in order.listening]
        keys = Keys(time.monotonic(), lasting(self._bounds.highest, FASTEST))

        def dialled(received: Callable[[Message], None], began: Callable[[], None]) -> Bundle:
            bundle = dial(self._identity, station, self._links, addresses, received=received, began=began)
            self._sent = [
                Sent(number, camera, keys, bundle, self._policy, self._bounds)
                for number, camera in enumerate(self._cameras.values())
            ]
            with self._lock:
                self._driving, self._bundle, self._keys = driving, bundle, keys
            return bundle

        self._unit.join(dialled, lambda _: self._sent)

    def _leave(self, why: str) -> None:
        with self._lock:
            self._driving = self._bundle = self._keys = None
        self._unit.release(why)
        for one in self._sent:
            one.close()
        self._sent = []

    def _tell_keys(self) -> None:
        while not self._ended.wait(TOLD):
            with self._lock:
                bundle, keys = self._bundle, self._keys
            if bundle is not None and keys is not None:
                for key in keys.told(time.monotonic()):
                    bundle.send(Kind.KEY, key.pack())


def serve(params: VehicleParams, ended: threading.Event, say: Callable[[str], None]) -> None:
    """Be a vehicle until that is ended; `say` is told what happens.

    Raises:
        ScanError: its certificate can't be read, a link or camera is none, or a thread has failed.
    """
    identity = Identity.read(params.certificates, Role.VEHICLE)
    gateway = address("GATEWAY", params.gateway, GATEWAY)
    links = [Link(*_named("--link", text)) for text in params.link] or [Link("one")]
    unit = CarUnit(CarParams(translator=params.translator, key=params.key, limit=params.limit))
    filmed = {name: _camera(name, source, params, unit) for name, source in _cameras(params)}
    bounds = Bounds(highest=round(params.bitrate * 1e6))
    policy = Policy.SHARE if params.share else Policy.COPY
    vehicle = Vehicle(identity, unit, links, filmed, policy, bounds)
    membership = Membership(identity, gateway, vehicle, say)
    say(f"{identity.me} drives by the translator at {params.translator}; Ctrl-C ends it")
    try:
        while not ended.wait(0.5):
            if not vehicle.alive():
                raise StepError(str(identity.me), f"has failed ({unit.failed})", "It stands; start it again")
    finally:
        membership.close()
        vehicle.close()


def _named(option: str, text: str) -> tuple[str, str]:
    name, _, rest = text.partition("=")
    if not name or not rest or len(name) > 60:
        raise SettingError(option, f"{redacted(text):.80} is no NAME=VALUE", "`--help` says what it means")
    return name, rest


def _cameras(params: VehicleParams) -> list[tuple[str, str]]:
    named = [_named("--camera", text) for text in params.camera]
    if len({name for name, _ in named}) < len(named):
        raise SettingError("--camera", "names two alike", "Give each a name of its own")
    return named


def _camera(name: str, source: str, params: VehicleParams, unit: CarUnit) -> Camera:
    """A camera of KIND:WHERE."""
    kind, _, where = source.partition(":")
    view = View(where, *params.size, params.rate)
    if kind == "world":
        where, _, turn = where.rpartition("@") if "@" in where else (where, "", "0")
        try:
            mount = Mount(yaw=float(turn))
        except ValueError:
            raise SettingError("--camera", f"{turn!r} are no degrees", "Write it as left=world:DIR@90") from None
        place = Place(Ground(read_scene(Path(where))))
        view = view._replace(where=where, mount=mount, pose=lambda: place(unit.car.vehicle()))
    return Camera(name, lambda: cameras.pictures(kind, view))
