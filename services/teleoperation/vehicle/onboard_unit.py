"""The car unit: obeys the joined station's commands by `safety`, tells the translator, and tells the station.

`Car` is what it knows and decides; `CarUnit` has the threads around it. The watchdog has one of its own, on the
monotonic clock, in which nothing waits: neither for the network, nor for pictures.
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
from typing import Annotated, Any, Protocol

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.teleoperation.control.controls import VehicleState
from scan2sim.services.teleoperation.control.messages import (
    LARGEST,
    Command,
    Kind,
    Lacking,
    Malformed,
    Message,
    Report,
    Stream,
    Streams,
    Telemetry,
    Wanted,
)
from scan2sim.services.teleoperation.control.safety import LIMIT_MS, MS, Safety
from scan2sim.services.teleoperation.vehicle.adapter import read_key
from scan2sim.services.teleoperation.vehicle.adapter_protocol import LARGEST as LARGEST_ANSWER
from scan2sim.services.teleoperation.vehicle.adapter_protocol import PERIOD_MS, PORT, Answer, CarEnd, Order

WATCHED, TOLD, LISTED = 0.005, 0.02, 1.0
"""Seconds between looks of the watchdog, telemetries, and lists of the cameras."""
ROOM = LARGEST - 64
"""Bytes of a message's body: the rest is its header's, and the links'."""
SILENT = "the translator is silent"
NOBODY, UNTIED = "nobody has joined", "the clocks aren't tied yet"
"""Why driving can't begin; the second also why commands are dropped."""
MALFORMED = "malformed"


class CarParams(Params):
    """Of a car unit's way to its translator."""

    translator: Annotated[str, Field(description="Host and UDP port of the vehicle's translator.")] = (
        f"127.0.0.1:{PORT}"
    )
    key: Annotated[File | None, Field(description="File with the key that car unit and translator share.")] = None
    limit: Annotated[
        float, Field(ge=20, le=5000, description="Milliseconds after which a command is old, and the vehicle stops.")
    ] = LIMIT_MS

    def address(self) -> tuple[str, int]:
        """Of the translator.

        Raises:
            SettingError: it is none.
        """
        host, colon, port = self.translator.rpartition(":")
        if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
            raise SettingError("translator", f"{self.translator!r} is no address", "Write it as 127.0.0.1:7447")
        return host.strip("[]"), int(port)


class Clocks(Protocol):
    """What is known of the station's clock (`clocks`)."""

    @property
    def known(self) -> bool:
        """Whether there was an exchange."""

    @property
    def uncertainty_ms(self) -> float:
        """Of what is known."""

    @property
    def wall_apart_s(self) -> float:
        """Seconds between the wall clocks."""

    @property
    def wall_wrong(self) -> bool:
        """Whether one of those must be wrong."""

    def age_ms(self, sent: int) -> float:
        """Since a stamp of the station's; infinite while nothing is known."""


class Bundle(Protocol):
    """All links to the station (`bundle`)."""

    @property
    def clocks(self) -> Any:
        """`Clocks`."""

    def send(self, kind: Kind, body: bytes) -> int:
        """Over all links; never waits."""

    def close(self) -> None:
        """Hang up."""


class Sender(Protocol):
    """Sends a camera's video."""

    @property
    def stream(self) -> Stream:
        """What the station is told of it."""

    @property
    def fault(self) -> str:
        """What is wrong with it, in words; "": nothing."""

    def want_key(self) -> None:
        """Send a key frame next."""

    def send_again(self, source: int, sequences: Sequence[int]) -> None:
        """Send packets again that didn't come."""

    def adapt(self, report: Report) -> None:
        """Follow what the links carry."""


class Car:
    """What a car unit knows and decides; may be called from any thread. Times: nanoseconds of the monotonic clock.

    Nothing foreign is called while the lock is held, so that nothing foreign keeps the watchdog waiting.

    Attributes:
        safety: which commands are obeyed.
        end: what is known of the translator.
    """

    def __init__(self, limit_ms: float = LIMIT_MS) -> None:
        self.safety, self.end = Safety(limit_ms), CarEnd(limit_ms)
        self._lock = threading.Lock()
        self._session: object | None = None
        self._bundle: Bundle | None = None
        self._cameras: Sequence[Sender] = ()
        self._doubt = NOBODY
        self._counts: Counter[str] = Counter()

    def join(self, session: object, bundle: Bundle, cameras: Sequence[Sender]) -> None:
        """Obey a station's driver, and nobody else, once that one has confirmed."""
        with self._lock:
            self._session, self._bundle, self._cameras, self._doubt = session, bundle, cameras, UNTIED
            self.safety.begin(session, "another driver has joined")

    def began(self, session: object) -> None:
        """A session's station has started anew, and counts its messages from 0 again."""
        with self._lock:
            if session is self._session:
                self.safety.begin(session, "the station has started anew")

    def release(self, reason: str) -> None:
        """Obey nobody."""
        with self._lock:
            self._session, self._bundle, self._cameras, self._doubt = None, None, (), NOBODY
            self.safety.end(reason)

    def hear(self, session: object, message: Message, now: int) -> None:
        """Take a message of a session's station; of any but the joined one's, none is obeyed."""
        bundle, cameras = self._bundle, self._cameras
        try:
            if message.kind == Kind.COMMAND:
                self._command(session, bundle, message, now)
            elif session is self._session:
                _about_video(cameras, message)
        except Malformed:
            self._counts[MALFORMED] += 1

    def answered(self, answer: Answer, now: int) -> None:
        """Take what the translator answered."""
        with self._lock:
            stopped = self.end.hear(answer, now)
            if stopped:
                self.safety.halt(stopped)

    def look(self, now: int) -> Order:
        """The watchdog's look: what to tell the translator now."""
        with self._lock:
            silent = self.end.silent(now)
            self.safety.hindrance = SILENT if silent else self._doubt
            if silent:
                self.safety.halt(SILENT)
            controls = self.safety.check(now)
            return self.end.order(controls, self.safety.old(now), not self.safety.standing, now)

    def doubt(self) -> None:
        """Look at the clocks, without which driving can't begin."""
        bundle = self._bundle
        doubt = NOBODY if bundle is None else self._doubts(bundle.clocks)
        with self._lock:
            if bundle is self._bundle:
                self._doubt = doubt

    def vehicle(self) -> VehicleState:
        """What the vehicle told last."""
        answer = self.end.answer
        return answer.vehicle if answer else VehicleState()

    def telemetry(self, now: int) -> Telemetry:
        """How the vehicle is; among its faults are those of what it is reached and seen by."""
        faults = [f"the camera {one.stream.name}: {one.fault}" for one in self._cameras if one.fault]
        with self._lock:
            safety, vehicle = self.safety, self.vehicle()
            if self.end.silent(now):
                faults.insert(0, SILENT)
            reason = "; ".join(dict.fromkeys(filter(None, (safety.reason, safety.hindrance))))
            return Telemetry(
                replace(vehicle, faults=(*faults, *vehicle.faults)),
                safety.stop,
                safety.standing,
                reason[:200],
                safety.command,
                round(safety.age, 1),
                dict(safety.dropped + self._counts),
            )

    def streams(self) -> Streams:
        """The cameras."""
        return Streams(tuple(one.stream for one in self._cameras))

    def _command(self, session: object, bundle: Bundle | None, message: Message, now: int) -> None:
        command, age = Command.unpack(message.body), 0.0
        if session is self._session and bundle is not None:
            age = bundle.clocks.age_ms(message.sent)
            if not isfinite(age):
                self._counts[UNTIED] += 1
                return
        with self._lock:
            self.safety.hear(session, message.number, command, now - round(age * MS), now)

    def _doubts(self, clocks: Clocks) -> str:
        """Why driving can't begin; "": it can."""
        if not clocks.known:
            return UNTIED
        if clocks.uncertainty_ms > self.safety.limit_ms:
            return f"the station's clock is known to {clocks.uncertainty_ms:.0f} ms only"
        if clocks.wall_wrong:
            return f"vehicle's and station's clocks are {abs(clocks.wall_apart_s):.0f} s apart: does NTP run on both?"
        return ""


def _about_video(cameras: Sequence[Sender], message: Message) -> None:
    if message.kind == Kind.WANTED:
        camera = Wanted.unpack(message.body).camera
        for one in cameras[camera : camera + 1]:
            one.want_key()
    elif message.kind == Kind.LACKING:
        lacking = Lacking.unpack(message.body)
        camera = lacking.source & 0xFF
        for one in cameras[camera : camera + 1]:
            one.send_again(lacking.source, lacking.sequences)
    elif message.kind == Kind.REPORT:
        report = Report.unpack(message.body)
        for one in cameras[report.camera : report.camera + 1]:
            one.adapt(report)


Dial = Callable[[Callable[[Message], None], Callable[[], None]], Bundle]
"""Makes the links to a station: they hand messages to the first, and call the second when it has started anew."""


class CarUnit:
    """A car unit at work: `watchdog`, `translator` (its answers) and `telemetry` are its threads.

    Attributes:
        car: what it knows.
        failed: what ended a thread that shouldn't have; the vehicle stands then, by its translator.
    """

    def __init__(self, params: CarParams) -> None:
        self.car = Car(params.limit)
        self.failed: BaseException | None = None
        self._key = read_key(params.key)
        host, port = params.address()
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise SettingError(
                "translator", f"{host} can't be reached: {error}", "Write it as 127.0.0.1:7447"
            ) from None
        self._socket.settimeout(0.2)
        self._bundle: Bundle | None = None
        self._ended = threading.Event()
        jobs = {"watchdog": self._watch, "translator": self._listen, "telemetry": self._tell}
        self._threads = [
            threading.Thread(target=self._guarded, args=(job,), name=name, daemon=True) for name, job in jobs.items()
        ]
        for thread in self._threads:
            thread.start()

    def join(self, dial: Dial, cameras: Callable[[Bundle], Sequence[Sender]] = lambda _: ()) -> Bundle:
        """Join a station in place of any other; cameras are sent over the bundle that is made."""
        self.release("another driver joins")
        session = object()
        bundle = dial(partial(self._hear, session), partial(self.car.began, session))
        self.car.join(session, bundle, cameras(bundle))
        self._bundle = bundle
        return bundle

    def release(self, reason: str) -> None:
        """Obey nobody, and hang up; the vehicle stands."""
        self.car.release(reason)
        bundle, self._bundle = self._bundle, None
        if bundle is not None:
            bundle.close()

    def close(self) -> None:
        """End; the vehicle stands."""
        self.release("the car unit ends")
        time.sleep(4 * WATCHED)  # the translator is told
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def _hear(self, session: object, message: Message) -> None:
        self.car.hear(session, message, time.monotonic_ns())

    def _guarded(self, job: Callable[[], None]) -> None:
        """A thread that fails takes the others with it: the translator hears nothing more, and stops the vehicle."""
        try:
            job()
        except BaseException as error:
            self.failed = error
            self._ended.set()
            raise

    def _watch(self) -> None:
        told, due = None, 0
        while not self._ended.wait(WATCHED):
            now = time.monotonic_ns()
            order = self.car.look(now)
            if order.command != told or now >= due:
                told, due = order.command, now + round(PERIOD_MS * MS)
                with contextlib.suppress(OSError):  # nobody listens there: no answer comes, and that is told
                    self._socket.send(order.pack(self._key))

    def _listen(self) -> None:
        while not self._ended.is_set():
            try:
                answer = Answer.unpack(self._socket.recv(LARGEST_ANSWER + 1), self._key)
            except (TimeoutError, Malformed):
                continue
            except OSError:  # nobody listens there
                self._ended.wait(WATCHED)
                continue
            self.car.answered(answer, time.monotonic_ns())

    def _tell(self) -> None:
        streams, due = Streams(()), 0.0
        while not self._ended.wait(TOLD):
            self.car.doubt()
            bundle = self._bundle
            if bundle is None:
                continue
            bundle.send(Kind.TELEMETRY, fitting(self.car.telemetry(time.monotonic_ns())))
            if (now := self.car.streams()) != streams or time.monotonic() > due:
                streams, due = now, time.monotonic() + LISTED
                bundle.send(Kind.STREAMS, streams.pack())


def fitting(telemetry: Telemetry) -> bytes:
    """As a message's body, the last faults left out where it would be too long."""
    while len(body := telemetry.pack()) > ROOM and telemetry.vehicle.faults:
        telemetry = replace(telemetry, vehicle=replace(telemetry.vehicle, faults=telemetry.vehicle.faults[:-1]))
    return body
