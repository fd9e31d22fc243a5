"""A vehicle: onboard unit, cameras and links, controlled by orders of the gateway; `serve` is the command."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from scan2sim.pipeline.core.errors import SettingError, StepError
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.credentials import redacted
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation import cameras, encoders
from scan2sim.services.teleoperation.adapter_key import ADAPTER_KEY_FILE
from scan2sim.services.teleoperation.cameras import Camera, Mount, OpenWorld, View
from scan2sim.services.teleoperation.control.messages import CongestionReport, Kind, Message, VideoReport, VideoStream
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway_protocol import CurrentPair, Hello, Join, Release, RequestRejected, Status
from scan2sim.services.teleoperation.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.settings import GATEWAY_PORT, OnboardParams, VehicleParams, parse_address
from scan2sim.services.teleoperation.sim.bicycle import Ground, PoseTracker
from scan2sim.services.teleoperation.transport.link_stats import LinkRates
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection, Policy
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardUnit
from scan2sim.services.teleoperation.video.capture import CameraEncoder, CameraStreamer
from scan2sim.services.teleoperation.video.rate_control import BitrateBounds, EncodingPlan, RateController
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule, key_lifetime

CAMERA_FPS_MAX = 60.0
"""Maximum frame rate of a camera."""
PAUSE_MAX_S, SHARE_MIN = 0.4, 0.25
"""Maximum time without frames in which a queue drains, seconds; least share of the sent rate that is believed."""
KEY_PERIOD_S = 0.5
"""Interval at which keys of the video encryption are sent; repeated since messages may be lost."""


def drain_s(report: CongestionReport, round_trip: float) -> float:
    """Time without video in which the queue drains, seconds; `round_trip`: without the queue, seconds.

    The queue has grown since the reported packet was sent: all that time `1 / share` of what the links carry was sent.
    """
    queue = report.queue_ms / 1e3
    return min(queue + (queue + round_trip) * (1 / max(report.share, SHARE_MIN) - 1), PAUSE_MAX_S)


class CameraSender:
    """Sends a camera's video to a station; see `onboard_unit.VideoSender`."""

    def __init__(
        self,
        number: int,
        camera: Camera,
        keys: KeySchedule,
        connection: MultipathConnection,
        policy: Policy,
        bounds: BitrateBounds,
    ) -> None:
        """Start sending."""
        self._encoder = CameraEncoder(number, keys, encoders.find())
        self._rate_controller = RateController(bounds, EncodingPlan(min(EncodingPlan().bitrate, bounds.highest)))
        self._camera, self._connection = camera, connection

        def send(packets: Sequence[bytes]) -> None:
            for packet in packets:
                connection.send_media(packet, policy)

        self._streamer = CameraStreamer(number, camera, self._encoder, send, self._rate_controller.plan)

    @property
    def stream(self) -> VideoStream:
        """Description of the stream for the station."""
        return self._streamer.stream

    @property
    def fault(self) -> str:
        """Why there is no video; empty: there is."""
        return self._streamer.fault or (self._camera.fault if self._camera.offline else "")

    def request_key_frame(self) -> None:
        """Make the next frame a key frame."""
        self._encoder.request_key_frame()

    def retransmit(self, source: int, sequences: Sequence[int]) -> None:
        """Retransmit missing packets over all links."""
        for packet in self._encoder.retransmit(source, sequences):
            self._connection.send_media(packet)

    def adapt(self, report: VideoReport) -> None:
        """Adapt the bit rate to what the links carry."""
        width, height = self._encoder.size
        self._streamer.plan = self._rate_controller.update(report, width, height)

    def relieve(self, report: CongestionReport) -> None:
        """Reduce the bit rate at once, and let the queue drain."""
        width, height = self._encoder.size
        self._streamer.plan = self._rate_controller.relieve(report, width, height)
        round_trip = self._connection.round_trip
        self._streamer.pause(drain_s(report, 0.0 if math.isnan(round_trip) else round_trip))

    def close(self) -> None:
        """Stop sending."""
        self._streamer.close()


class Vehicle:
    """A vehicle; implements `Party` for the gateway connection, from creation to `close`."""

    def __init__(
        self,
        identity: Identity,
        unit: OnboardUnit,
        links: Sequence[Link],
        cameras: Mapping[str, Camera],
        policy: Policy,
        bounds: BitrateBounds,
    ) -> None:
        """Start with a running onboard unit.

        Args:
            links: links to the station.
            cameras: by name; the driver page shows the first one largest.
            policy: whether video packets go over all links, or over one in turn.
            bounds: of each camera's bit rate.
        """
        self._identity, self._unit, self._links = identity, unit, tuple(links)
        self._cameras, self._policy, self._bounds = dict(cameras), policy, bounds
        self._lock = threading.Lock()
        self._driving: CurrentPair | None = None
        self._connection: MultipathConnection | None = None
        self._senders: list[CameraSender] = []
        self._keys: KeySchedule | None = None
        self._rates = LinkRates()
        self._ended = threading.Event()
        self._key_thread = SupervisedThread(self._send_keys, "video keys")
        self._key_thread.start()

    def hello(self) -> Hello:
        """See `Party`."""
        return Hello(cameras=tuple(self._cameras), driving=self._driving)

    def status(self) -> Status:
        """See `Party`."""
        with self._lock:
            driving, connection = self._driving, self._connection
        now = time.monotonic_ns()
        speed = self._unit.car.speed(now)
        if driving is None or connection is None:
            return Status(speed=speed)
        telemetry = self._unit.car.telemetry(now)
        reason = telemetry.reason if telemetry.standing else "; ".join(telemetry.vehicle.faults)
        return Status(
            pair=driving.pair, links=self._rates.links(connection), driving=not telemetry.standing,
            message=reason[:200], speed=speed, age=telemetry.age,
        )  # fmt: skip

    def handle_order(self, order: Join | Release | RequestRejected) -> None:
        """See `Party`."""
        if isinstance(order, Join):
            driving = CurrentPair(pair=order.pair, other=order.other.name)
            if driving != self._driving:
                self._leave("another driver joins")
                self._join(order, driving)
        elif isinstance(order, Release):
            self._leave(order.why or "it was released")

    def alive(self) -> bool:
        """Whether its threads are alive."""
        return self._key_thread.is_alive() and self._unit.failed is None

    def close(self) -> None:
        """Disconnect from the station; the vehicle stops."""
        self._ended.set()
        self._leave("the onboard unit ends")
        self._key_thread.join(2.0)
        self._unit.close()
        for camera in self._cameras.values():
            camera.close()

    def _join(self, order: Join, driving: CurrentPair) -> None:
        station = Peer(Role.STATION, order.other.name, order.other.fingerprint)
        addresses = [(one.host, one.port) for one in order.listening]
        keys = KeySchedule(time.monotonic(), key_lifetime(self._bounds.highest, CAMERA_FPS_MAX))

        def connect(received: Callable[[Message], None], restarted: Callable[[], None]) -> MultipathConnection:
            connection = connect_station(
                self._identity, station, self._links, addresses, received=received, restarted=restarted
            )
            self._senders = [
                CameraSender(number, camera, keys, connection, self._policy, self._bounds)
                for number, camera in enumerate(self._cameras.values())
            ]
            with self._lock:
                self._driving, self._connection, self._keys = driving, connection, keys
            return connection

        self._unit.join(connect, lambda _: self._senders)

    def _leave(self, reason: str) -> None:
        with self._lock:
            self._driving = self._connection = self._keys = None
        self._unit.release(reason)
        for one in self._senders:
            one.close()
        self._senders = []

    def _send_keys(self) -> None:
        while not self._ended.wait(KEY_PERIOD_S):
            with self._lock:
                connection, keys = self._connection, self._keys
            if connection is not None and keys is not None:
                for key in keys.announced(time.monotonic()):
                    connection.send(Kind.VIDEO_KEY, key.pack())


def serve(
    params: VehicleParams,
    ended: threading.Event,
    notify: Callable[[str], None],
    open_world: OpenWorld | None = None,
) -> None:
    """Run a vehicle until `ended` is set; `notify` is called with progress messages.

    `open_world` opens worlds with splats for the cameras of a simulated vehicle; without it, they have none.

    Raises:
        ScanError: the certificate can't be read, a link or camera is not valid, or a thread has failed.
    """
    identity = Identity.read(params.certificates, Role.VEHICLE)
    gateway = parse_address("GATEWAY", params.gateway, GATEWAY_PORT)
    links = [Link(*_parse_named("--link", text)) for text in params.link] or [Link("one")]
    key = params.key or params.certificates / ADAPTER_KEY_FILE
    unit = OnboardUnit(OnboardParams(adapter=params.adapter, key=key, limit=params.limit))
    cameras_by_name = {name: _camera(name, source, params, unit, open_world) for name, source in _cameras(params)}
    bounds = BitrateBounds(highest=round(params.bitrate * 1e6))
    policy = Policy.SHARE if params.share else Policy.COPY
    vehicle = Vehicle(identity, unit, links, cameras_by_name, policy, bounds)
    gateway_connection = GatewayConnection(identity, gateway, vehicle, notify)
    notify(f"{identity.me} is controlled by the vehicle adapter at {params.adapter}; Ctrl-C ends it")
    try:
        while not ended.wait(0.5):
            if not vehicle.alive():
                raise StepError(str(identity.me), f"has failed ({unit.failed})", "The vehicle is stopped; restart it")
    finally:
        gateway_connection.close()
        vehicle.close()


def _parse_named(option: str, text: str) -> tuple[str, str]:
    name, _, rest = text.partition("=")
    if not name or not rest or len(name) > 60:
        raise SettingError(option, f"{redacted(text):.80} is not NAME=VALUE", "See `--help` for the format")
    return name, rest


def _cameras(params: VehicleParams) -> list[tuple[str, str]]:
    named = [_parse_named("--camera", text) for text in params.camera]
    if len({name for name, _ in named}) < len(named):
        raise SettingError("--camera", "two cameras have the same name", "Give each camera a unique name")
    return named


def _camera(name: str, source: str, params: VehicleParams, unit: OnboardUnit, open_world: OpenWorld | None) -> Camera:
    """Camera from KIND:WHERE."""
    kind, _, location = source.partition(":")
    view = View(location, *params.size, params.rate)
    if kind in ("world", "surfaces"):
        location, _, yaw = location.rpartition("@") if "@" in location else (location, "", "0")
        try:
            mount = Mount(yaw=float(yaw))
        except ValueError:
            cause = f"{yaw!r} is not a number of degrees"
            raise SettingError("--camera", cause, "Write it as left=world:DIR@90") from None
        pose_tracker = PoseTracker(Ground(read_scene(Path(location))))
        view = view._replace(location=location, mount=mount, pose=lambda: pose_tracker(unit.car.vehicle()))
        view = view._replace(open_world=open_world)
    return Camera(name, lambda: cameras.frames(kind, view))
