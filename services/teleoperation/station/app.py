"""The station: video, telemetry and links of the joined vehicle, and the commands of its driver.

Accepts connections of vehicles, follows orders of the gateway, and passes frames and state to the driver page (`web`).
Commands are sent to the vehicle fifty times a second while the driver's page keeps sending controls (`DriverSession`).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation.control.driver_session import DriverSession
from scan2sim.services.teleoperation.control.messages import (
    Command,
    CongestionReport,
    KeyFrameRequest,
    Kind,
    Malformed,
    Message,
    Nack,
    Telemetry,
    VideoKey,
    VideoReport,
    VideoStreams,
)
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway_protocol import (
    Address,
    CurrentPair,
    DriverEvent,
    DriverRequest,
    Hello,
    Join,
    Release,
    RequestRejected,
    Status,
)
from scan2sim.services.teleoperation.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport.link_stats import LinkRates
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, VideoReceiver

COMMAND_RATE_HZ = 50.0
"""Rate at which commands are sent."""
REPORT_PERIOD_S, REPORT_SPREAD_S = 1.0, 0.8
"""Interval between two video reports to the vehicle, and time over which those of its cameras are spread: each may
change a rate, which costs a key frame."""
STATE_MAX_AGE_MS = 275.0
"""Age above which the vehicle's state is not passed to pages any more; `MAX_AGE` of the page."""
DEFAULT_ROUND_TRIP_S = 0.1
"""Assumed round-trip time to the vehicle until it is measured."""


class JoinedVehicle:
    """The vehicle that the station is joined with: telemetry, video, links.

    Attributes:
        telemetry: the latest, sent at `sent` (ns of the vehicle's monotonic clock).
        streams: the vehicle's cameras; `reports`: receiver statistics of their video over the last second.
        malformed: number of messages that could not be decoded.
    """

    def __init__(self, pair: int, vehicle: Peer, listener: Listener, show: Callable[[Frame], None]) -> None:
        """`show` is called with each frame, in the receiving thread."""
        self.pair, self.vehicle = pair, vehicle
        self.telemetry: Telemetry | None = None
        self.sent = 0
        self.streams: VideoStreams = VideoStreams(())
        self.malformed = 0
        self.reports: tuple[VideoReport, ...] = ()
        self.rates = LinkRates()
        self.receiver = VideoReceiver(
            frame=show,
            request_key_frame=self.request_key_frame,
            age=self.age,
            send_nack=self._send_nack,
            round_trip=self._round_trip,
            congested=self._send_congestion,
        )
        self._listener = listener
        self.connection: MultipathConnection = listener.expect(
            vehicle, received=self._received, media=self.receiver.feed
        )

    def age(self, captured: int) -> float:
        """Age of a time of the vehicle's monotonic clock (ns), milliseconds."""
        return self.connection.clocks.age_ms(captured)

    def telemetry_age_ms(self) -> float | None:
        """Milliseconds since the vehicle sent its telemetry, time in queues included; None: unknown."""
        age = self.age(self.sent)
        return None if self.telemetry is None or math.isinf(age) else age

    def request_key_frame(self, camera: int) -> None:
        """Request a key frame of a camera."""
        self.connection.send(Kind.KEY_FRAME_REQUEST, KeyFrameRequest(camera).pack())

    def _send_nack(self, source: int, sequences: Sequence[int]) -> None:
        self.connection.send(Kind.NACK, Nack(source, tuple(sequences)).pack())

    def _send_congestion(self, report: CongestionReport) -> None:
        self.connection.send(Kind.CONGESTION, report.pack())

    def _round_trip(self) -> float:
        """Round-trip time to the vehicle, seconds."""
        measured = self.connection.round_trip
        return DEFAULT_ROUND_TRIP_S if math.isnan(measured) else measured

    def report(self, wait: Callable[[float], bool]) -> None:
        """Send video reports of all cameras to the vehicle; `wait` pauses in between, and returns whether to end."""
        self.reports = tuple(self.receiver.reports())
        for one in self.reports:
            self.connection.send(Kind.VIDEO_REPORT, one.pack())
            if wait(REPORT_SPREAD_S / len(self.reports)):
                return

    def _received(self, message: Message) -> None:
        try:
            match message.kind:
                case Kind.TELEMETRY:
                    self.telemetry, self.sent = Telemetry.unpack(message.body), message.sent
                case Kind.VIDEO_KEY:
                    self.receiver.add_key(VideoKey.unpack(message.body))
                case Kind.STREAMS:
                    self.streams = VideoStreams.unpack(message.body)
                case _:
                    self.malformed += 1
        except Malformed:
            self.malformed += 1

    def blocked_by(self) -> str:
        """Why driving is not possible; empty: it is."""
        clocks = self.connection.clocks
        if not any(link.up for link in self.connection.links):
            return "no link to the vehicle is up"
        if not clocks.known:
            return "the clocks have not been synchronized yet"
        if clocks.wall_wrong:
            return f"the vehicle's clock differs by {clocks.wall_apart_s:+.1f} s from this one: synchronize both by NTP"
        return ""

    def close(self) -> None:
        """Disconnect from the vehicle."""
        self._listener.forget(self.vehicle)
        self.connection.close()


class Station:
    """A station; implements `Party` for the gateway connection.

    Attributes:
        driver_session: the control lock.
        report_event: called with what drivers do, for the gateway's audit trail.
        record_command: called with each command that is sent.
    """

    def __init__(
        self,
        identity: Identity,
        listener: Listener,
        reached: Sequence[Address],
        show: Callable[[Frame], None],
    ) -> None:
        """Start the threads; the station waits for the gateway to join it with a vehicle.

        Args:
            identity: the station's own.
            listener: accepts connections of vehicles.
            reached: the listener's addresses, as vehicles reach them.
            show: called with each frame.
        """
        self.identity, self.driver_session = identity, DriverSession(self._log_event)
        self.report_event: Callable[[DriverEvent], None] = lambda event: None
        self.record_command: Callable[[Command], None] = lambda command: None
        self._listener, self._reached, self._show = listener, tuple(reached), show
        self._lock = threading.Lock()
        self._joined: JoinedVehicle | None = None
        self._why = "no vehicle is joined"
        self._ended = threading.Event()
        self._threads = [
            SupervisedThread(self._drive, "commands"),
            SupervisedThread(self._report, "video reports"),
        ]
        for thread in self._threads:
            thread.start()

    # interface `Party` of the gateway connection

    def hello(self) -> Hello:
        """See `Party`."""
        joined = self.joined()
        driving = None if joined is None else CurrentPair(pair=joined.pair, other=joined.vehicle.name)
        return Hello(listening=self._reached, driving=driving)

    def status(self) -> Status:
        """See `Party`."""
        joined = self.joined()
        if joined is None:
            return Status(message=self._why)
        delays = [report.delay for report in joined.reports if report.delay is not None]
        driver, held = self.driver_session.held(time.monotonic())
        return Status(
            pair=joined.pair,
            links=joined.rates.links(joined.connection),
            driving=bool(driver),
            driver=driver[:200],
            held=held,
            message=joined.blocked_by()[:200],
            age=max(delays) if delays else None,
        )

    def handle_order(self, order: Join | Release | RequestRejected) -> None:
        """See `Party`."""
        if isinstance(order, RequestRejected):
            self._why = order.cause
            return
        vehicle = None
        if isinstance(order, Join):
            vehicle = Peer(Role.VEHICLE, order.other.name, order.other.fingerprint)
        before = self.joined()
        if before is not None and isinstance(order, Join) and (before.pair, before.vehicle) == (order.pair, vehicle):
            return
        with self._lock:
            self._joined = None
        if before is not None:
            before.close()
            self.driver_session.release(self.driver_session.holder() or "", "the vehicle was released")
        if isinstance(order, Join) and vehicle is not None:
            joined = JoinedVehicle(order.pair, vehicle, self._listener, self._show)
            with self._lock:
                self._joined = joined
        elif isinstance(order, Release):
            self._why = order.why

    # for the driver page

    def joined(self) -> JoinedVehicle | None:
        """The joined vehicle; None: there is none."""
        with self._lock:
            return self._joined

    def snapshot(self) -> dict[str, Any]:
        """State of station and vehicle for the driver page."""
        joined = self.joined()
        state: dict[str, Any] = {
            "station": self.identity.me.name,
            "driver": self.driver_session.holder(),
            "left": self.driver_session.release_reason,
            "latched": self.driver_session.latched,
        }
        if joined is None:
            return state | {"vehicle": None, "why": self._why}
        clocks, age = joined.connection.clocks, joined.telemetry_age_ms()
        outdated = age is None or age > STATE_MAX_AGE_MS
        return state | {
            "vehicle": joined.vehicle.name,
            "why": joined.blocked_by(),
            "telemetry": None if joined.telemetry is None or outdated else asdict(joined.telemetry),
            "telemetry_age_ms": age,
            "cameras": [asdict(one) for one in joined.streams.cameras],
            "links": [one.model_dump() for one in joined.rates.links(joined.connection)],
            "clocks": {"uncertainty_ms": clocks.uncertainty_ms, "wall_apart_s": clocks.wall_apart_s}
            if clocks.known
            else None,
        }

    def request_key_frames(self) -> None:
        """Request a key frame of each camera."""
        if (joined := self.joined()) is not None:
            for camera in joined.streams.cameras:
                joined.request_key_frame(camera.camera)

    def alive(self) -> bool:
        """Whether its threads are alive."""
        return all(thread.is_alive() for thread in self._threads)

    def close(self) -> None:
        """Stop sending commands, so that the vehicle stops, and disconnect."""
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        self.handle_order(Release())

    def _log_event(self, what: str, driver: str) -> None:
        self.report_event(DriverEvent(what=what[:200], driver=driver[:200], time=round(time.time(), 3)))

    def _drive(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            joined, command = self.joined(), self.driver_session.command(time.monotonic())
            if joined is not None and command is not None and not joined.blocked_by():
                joined.connection.send(Kind.COMMAND, command.pack())
                self.record_command(command)
            due = max(due + 1 / COMMAND_RATE_HZ, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _report(self) -> None:
        due = time.monotonic()
        while not self._ended.wait(due - time.monotonic()):
            due = max(due + REPORT_PERIOD_S, time.monotonic())
            if (joined := self.joined()) is not None:
                joined.report(self._ended.wait)


def send_request(gateway_connection: GatewayConnection, what: str, vehicle: str, driver: str) -> bool:
    """Request the gateway to join or to release a vehicle; False: the gateway isn't connected."""
    return gateway_connection.send_request(
        DriverRequest(what="join" if what == "join" else "release", vehicle=vehicle, driver=driver)
    )
