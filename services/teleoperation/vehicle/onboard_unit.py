"""The onboard unit: obeys the joined station's commands by the safety rules, controls the vehicle through its adapter.

`OnboardController` has state and decisions; `OnboardUnit` has the threads around it, and sends telemetry to the
station. The watchdog has its own thread, on the monotonic clock, in which nothing waits for network or video.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import isfinite
from typing import Any, Protocol

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import VehicleState
from scan2sim.services.teleoperation.control.messages import (
    MESSAGE_MAX_BYTES,
    Command,
    CongestionReport,
    KeyFrameRequest,
    Kind,
    Malformed,
    Message,
    Nack,
    Telemetry,
    VideoReport,
    VideoStream,
    VideoStreams,
)
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS, NS_PER_MS, SafetyMonitor
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.vehicle.adapter_protocol import ADAPTER_PERIOD_MS, Answer, OnboardEndpoint, Order
from scan2sim.services.teleoperation.vehicle.adapter_protocol import PACKET_MAX_BYTES as ANSWER_MAX_BYTES

WATCHDOG_PERIOD_S, TELEMETRY_PERIOD_S, STREAMS_PERIOD_S = 0.005, 0.02, 1.0
"""Intervals of the watchdog, of telemetry, and of the list of cameras."""
BODY_MAX_BYTES = MESSAGE_MAX_BYTES - 64
"""Maximum size of a message body; the rest is for headers of message and link."""
SPEED_MAX_AGE_MS = 300.0
"""Age of the adapter's answer above which the fleet page gets no speed, ms."""
ADAPTER_SILENT = "the vehicle adapter does not respond"
NO_STATION, CLOCKS_UNKNOWN = "no station is joined", "the clocks are not synchronized yet"
"""Reasons for which driving can't begin."""
DROP_CLOCKS_UNKNOWN, MALFORMED = "the clocks aren't synchronized yet", "malformed"
"""Further reasons for which messages are dropped; keys of `Telemetry.dropped`."""


class StationClock(Protocol):
    """Offset of the station's clocks (`clock_sync.ClockSync`)."""

    @property
    def known(self) -> bool:
        """Whether the offset is known."""

    @property
    def uncertainty_ms(self) -> float:
        """Maximum error of the offset, ms."""

    @property
    def wall_apart_s(self) -> float:
        """Station's wall clock minus ours, seconds."""

    @property
    def wall_wrong(self) -> bool:
        """Whether one of the wall clocks is wrong."""

    def age_ms(self, sent: int) -> float:
        """Age of a timestamp of the station, ms; infinite while the offset is unknown."""


class StationConnection(Protocol):
    """Connection to the station (`multipath.MultipathConnection`)."""

    @property
    def clocks(self) -> Any:
        """`StationClock`."""

    def send(self, kind: Kind, body: bytes) -> int:
        """Send over all links; never blocks."""

    def close(self) -> None:
        """Disconnect."""


class VideoSender(Protocol):
    """Sends a camera's video to the station."""

    @property
    def stream(self) -> VideoStream:
        """Description of the stream for the station."""

    @property
    def fault(self) -> str:
        """Why there is no video; "": there is."""

    def request_key_frame(self) -> None:
        """Make the next frame a key frame."""

    def retransmit(self, source: int, sequences: Sequence[int]) -> None:
        """Retransmit missing packets."""

    def adapt(self, report: VideoReport) -> None:
        """Adapt the bit rate to what the links carry."""

    def relieve(self, report: CongestionReport) -> None:
        """Reduce the bit rate at once, and let the queue drain."""


class OnboardController:
    """State and decisions of an onboard unit; thread-safe. Times: nanoseconds of the monotonic clock.

    While the lock is held no code outside this module is called, since it could block the watchdog.

    Attributes:
        safety: decides which commands are obeyed.
        endpoint: endpoint of the protocol with the vehicle adapter.
    """

    def __init__(self, limit_ms: float = COMMAND_MAX_AGE_MS) -> None:
        self.safety, self.endpoint = SafetyMonitor(limit_ms), OnboardEndpoint(limit_ms)
        self._lock = threading.Lock()
        self._session: object | None = None
        self._connection: StationConnection | None = None
        self._cameras: Sequence[VideoSender] = ()
        self._blocked_by = NO_STATION
        self._counts: Counter[str] = Counter()

    def join(self, session: object, connection: StationConnection, cameras: Sequence[VideoSender]) -> None:
        """Obey the driver of this station only, once the driver has confirmed."""
        with self._lock:
            self._session, self._connection, self._cameras, self._blocked_by = (
                session,
                connection,
                cameras,
                CLOCKS_UNKNOWN,
            )
            self.safety.begin(session, "another driver has joined")

    def station_restarted(self, session: object) -> None:
        """Handle the restart of a session's station, which counts its messages from 0 again."""
        with self._lock:
            if session is self._session:
                self.safety.begin(session, "the station has restarted")

    def release(self, reason: str) -> None:
        """Obey no station."""
        with self._lock:
            self._session, self._connection, self._cameras, self._blocked_by = None, None, (), NO_STATION
            self.safety.end(reason)

    def receive(self, session: object, message: Message, now: int) -> None:
        """Process a message of a session's station; commands of any but the joined station are dropped."""
        connection, cameras = self._connection, self._cameras
        try:
            if message.kind == Kind.COMMAND:
                self._receive_command(session, connection, message, now)
            elif session is self._session:
                _handle_video_message(cameras, message)
        except Malformed:
            self._counts[MALFORMED] += 1

    def receive_answer(self, answer: Answer, now: int) -> None:
        """Process an answer of the vehicle adapter."""
        with self._lock:
            stopped = self.endpoint.receive(answer, now)
            if stopped:
                self.safety.halt(stopped)

    def watchdog_order(self, now: int) -> Order:
        """Run the watchdog: the order to send to the vehicle adapter now."""
        with self._lock:
            silent = self.endpoint.silent(now)
            self.safety.blocked_by = ADAPTER_SILENT if silent else self._blocked_by
            if silent:
                self.safety.halt(ADAPTER_SILENT)
            controls = self.safety.check(now)
            return self.endpoint.order(controls, self.safety.command_age_ms(now), not self.safety.standing, now)

    def check_clocks(self) -> None:
        """Check clock synchronization, without which driving can't begin."""
        connection = self._connection
        reason = NO_STATION if connection is None else self._clock_problem(connection.clocks)
        with self._lock:
            if connection is self._connection:
                self._blocked_by = reason

    def vehicle(self) -> VehicleState:
        """Last reported state of the vehicle."""
        answer = self.endpoint.answer
        return answer.vehicle if answer else VehicleState()

    def speed(self, now: int) -> float | None:
        """Speed that the vehicle reported, m/s; None: it is unknown, or older than `SPEED_MAX_AGE_MS`."""
        return self.vehicle().speed if self.endpoint.answer_age_ms(now) <= SPEED_MAX_AGE_MS else None

    def telemetry(self, now: int) -> Telemetry:
        """State of the vehicle and its safety; faults include those of adapter and cameras."""
        faults = [f"camera {one.stream.name}: {one.fault}" for one in self._cameras if one.fault]
        with self._lock:
            safety, vehicle = self.safety, self.vehicle()
            if self.endpoint.silent(now):
                faults.insert(0, ADAPTER_SILENT)
            reason = "; ".join(dict.fromkeys(filter(None, (safety.reason, safety.blocked_by))))
            return Telemetry(
                replace(vehicle, faults=(*faults, *vehicle.faults)),
                safety.stop,
                safety.standing,
                reason[:200],
                safety.command,
                round(safety.age, 1),
                dict(safety.dropped + self._counts),
                round(self.endpoint.answer_age_ms(now), 1),
            )

    def streams(self) -> VideoStreams:
        """Streams of all cameras."""
        return VideoStreams(tuple(one.stream for one in self._cameras))

    def _receive_command(
        self, session: object, connection: StationConnection | None, message: Message, now: int
    ) -> None:
        command, age = Command.unpack(message.body), 0.0
        if session is self._session and connection is not None:
            age = connection.clocks.age_ms(message.sent)
            if not isfinite(age):
                self._counts[DROP_CLOCKS_UNKNOWN] += 1
                return
        with self._lock:
            self.safety.receive(session, message.number, command, now - round(age * NS_PER_MS), now)

    def _clock_problem(self, clocks: StationClock) -> str:
        """Why driving can't begin; "": it can."""
        if not clocks.known:
            return CLOCKS_UNKNOWN
        if clocks.uncertainty_ms > self.safety.limit_ms:
            return f"the offset of the station's clock is uncertain by {clocks.uncertainty_ms:.0f} ms"
        if clocks.wall_wrong:
            return f"the clocks of vehicle and station differ by {abs(clocks.wall_apart_s):.0f} s: check NTP on both"
        return ""


def _handle_video_message(cameras: Sequence[VideoSender], message: Message) -> None:
    if message.kind == Kind.KEY_FRAME_REQUEST:
        camera = KeyFrameRequest.unpack(message.body).camera
        for one in cameras[camera : camera + 1]:
            one.request_key_frame()
    elif message.kind == Kind.NACK:
        nack = Nack.unpack(message.body)
        camera = nack.source & 0xFF
        for one in cameras[camera : camera + 1]:
            one.retransmit(nack.source, nack.sequences)
    elif message.kind == Kind.VIDEO_REPORT:
        report = VideoReport.unpack(message.body)
        for one in cameras[report.camera : report.camera + 1]:
            one.adapt(report)
    elif message.kind == Kind.CONGESTION:
        congestion = CongestionReport.unpack(message.body)
        for one in cameras:
            one.relieve(congestion)


Connect = Callable[[Callable[[Message], None], Callable[[], None]], StationConnection]
"""Connects to a station; calls the first argument with each message, and the second when the station has restarted."""


class OnboardJobs:
    """Jobs of an onboard unit's threads, each called once per period; no thread, no network."""

    def __init__(
        self,
        car: OnboardController,
        key: bytes,
        send: Callable[[bytes], object],
        *,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare the jobs.

        Args:
            car: state and decisions.
            key: key shared with the vehicle adapter.
            send: sends a packet to the vehicle adapter.
            clock: monotonic clock, nanoseconds.
        """
        self._car, self._key, self._send, self._clock = car, key, send, clock
        self._last_command: Command | None = None
        self._order_due = self._streams_due = 0
        self._streams = VideoStreams(())

    def watch(self) -> None:
        """Run the watchdog, and send its order when the command has changed or the adapter's period has passed."""
        now = self._clock()
        order = self._car.watchdog_order(now)
        if order.command != self._last_command or now >= self._order_due:
            self._last_command, self._order_due = order.command, now + round(ADAPTER_PERIOD_MS * NS_PER_MS)
            self._send(order.pack(self._key))

    def receive_answer(self, packet: bytes) -> None:
        """Process a packet of the vehicle adapter."""
        with contextlib.suppress(Malformed):
            self._car.receive_answer(Answer.unpack(packet, self._key), self._clock())

    def send_telemetry(self, connection: StationConnection | None) -> None:
        """Check the clocks, and send telemetry and the list of cameras to the joined station, if any."""
        self._car.check_clocks()
        if connection is None:
            return
        now = self._clock()
        connection.send(Kind.TELEMETRY, pack_fitting(self._car.telemetry(now)))
        if (streams := self._car.streams()) != self._streams or now > self._streams_due:
            self._streams, self._streams_due = streams, now + round(STREAMS_PERIOD_S * 1e9)
            connection.send(Kind.STREAMS, streams.pack())


class OnboardUnit:
    """A running onboard unit, with the threads `watchdog`, `adapter` (its answers) and `telemetry`.

    Attributes:
        car: state and decisions.
        failed: error that ended a thread; the adapter stops the vehicle then.
    """

    def __init__(self, params: OnboardParams) -> None:
        self.car = OnboardController(params.limit)
        self.failed: BaseException | None = None
        self._jobs = OnboardJobs(self.car, adapter_key.read(params.key), self._send)
        host, port = params.address()
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise SettingError("adapter", f"{host} can't be reached: {error}", "Write it as 127.0.0.1:7447") from None
        self._socket.settimeout(0.2)
        self._connection: StationConnection | None = None
        self._ended = threading.Event()
        jobs = {"watchdog": self._watch, "adapter": self._receive_answers, "telemetry": self._send_telemetry}
        self._threads = [
            threading.Thread(target=self._guarded, args=(job,), name=name, daemon=True) for name, job in jobs.items()
        ]
        for thread in self._threads:
            thread.start()

    def join(
        self, connect: Connect, cameras: Callable[[StationConnection], Sequence[VideoSender]] = lambda _: ()
    ) -> StationConnection:
        """Join a station in place of any other; `cameras` creates the senders of its connection."""
        self.release("another driver joins")
        session = object()
        connection = connect(partial(self._receive, session), partial(self.car.station_restarted, session))
        self.car.join(session, connection, cameras(connection))
        self._connection = connection
        return connection

    def release(self, reason: str) -> None:
        """Obey no station, and disconnect; the vehicle stops."""
        self.car.release(reason)
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def close(self) -> None:
        """Stop the vehicle, and end all threads."""
        self.release("the onboard unit ends")
        self._ended.set()
        for thread in self._threads:
            thread.join()
        if self.failed is None:
            self._jobs.watch()  # the stop
        self._socket.close()

    def _receive(self, session: object, message: Message) -> None:
        self.car.receive(session, message, time.monotonic_ns())

    def _guarded(self, job: Callable[[], None]) -> None:
        """Run a thread; if it fails all others end: the adapter gets no more orders, and stops the vehicle."""
        try:
            job()
        except BaseException as error:
            self.failed = error
            self._ended.set()
            raise

    def _send(self, packet: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens there: reported since no answer arrives
            self._socket.send(packet)

    def _watch(self) -> None:
        while not self._ended.wait(WATCHDOG_PERIOD_S):
            self._jobs.watch()

    def _receive_answers(self) -> None:
        while not self._ended.is_set():
            try:
                packet = self._socket.recv(ANSWER_MAX_BYTES + 1)
            except TimeoutError:
                continue
            except OSError:  # nobody listens there
                self._ended.wait(WATCHDOG_PERIOD_S)
                continue
            self._jobs.receive_answer(packet)

    def _send_telemetry(self) -> None:
        while not self._ended.wait(TELEMETRY_PERIOD_S):
            self._jobs.send_telemetry(self._connection)


def pack_fitting(telemetry: Telemetry) -> bytes:
    """Encode as a message body; the last faults are dropped if it would be too long."""
    while len(body := telemetry.pack()) > BODY_MAX_BYTES and telemetry.vehicle.faults:
        telemetry = replace(telemetry, vehicle=replace(telemetry.vehicle, faults=telemetry.vehicle.faults[:-1]))
    return body
