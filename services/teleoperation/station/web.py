"""The driver page of a station: video, its latency, and driving; one WebSocket for each page (D3.2, section 4.3).

To the page: the state as JSON twenty times a second, and each frame behind a header (VP8, decoded by the browser).
From the page: JSON, `{"do": "take" | "leave" | "turn" | "stop" | "unlatch" | "join" | "release" | "key" | "clock",
...}`.

Frames and state carry a time of the station's monotonic clock, which the page compares with its own clock (`clock`). So
the page knows the age of everything it receives, including time spent in queues or in a suspended process.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access.drivers import Access, Driver, DriverRole
from scan2sim.services.teleoperation.access.sign_in import access, protected
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway_protocol import Address, DriverEvent
from scan2sim.services.teleoperation.identity import Identity, Role
from scan2sim.services.teleoperation.settings import GATEWAY_PORT, STATION_PORT, StationParams, parse_address
from scan2sim.services.teleoperation.station import app_window, road_map
from scan2sim.services.teleoperation.station.app import Station, send_request
from scan2sim.services.teleoperation.station.recorder import Recorder
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.video.jitter_buffer import Frame

log = logging.getLogger(__name__)

FRAME_HEADER = struct.Struct("<BBHHd")
"""Header of a frame: camera, key frame flag, width, height, capture time (ms of the station's monotonic clock)."""
STATUS_PERIOD_S = 0.05
"""Interval between two state messages."""
REVOCATION_PERIOD_S = 0.1
"""Interval at which a page's driver is checked."""
PAGE_QUEUE_MAX_FRAMES = 24
"""Maximum number of frames queued for a page; a page that falls behind continues with the next key frame."""
_page_numbers = itertools.count(1)


class _LockMessage(BaseModel):
    do: Literal["take", "leave"]
    why: Annotated[str, Field(max_length=100)] = ""


class _StopMessage(BaseModel):
    do: Literal["stop", "unlatch"]


class _ControlsMessage(BaseModel):
    do: Literal["turn"]
    steering: Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]
    throttle: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
    brake: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
    gear: Gear
    horn: bool = False
    lights: bool = False
    stop: Annotated[int, Field(ge=0, lt=2**32)] = 0
    agree: bool = False

    def command(self) -> Command:
        throttle = 0.0 if self.brake else self.throttle  # any brake overrides the throttle
        controls = Controls(self.steering, throttle, self.brake, self.gear, self.horn, self.lights)
        return Command(controls, self.stop, self.agree)


class _PairMessage(BaseModel):
    do: Literal["join", "release"]
    vehicle: Annotated[str, Field(min_length=1, max_length=60)]


class _KeyFrameMessage(BaseModel):
    do: Literal["key"]
    camera: Annotated[int, Field(ge=0, le=255)]


class _ClockMessage(BaseModel):
    do: Literal["clock"]
    sent: Annotated[float, Field(allow_inf_nan=False)]
    """Time of the page's clock, returned in the answer."""


_PageMessage = _LockMessage | _StopMessage | _ControlsMessage | _PairMessage | _KeyFrameMessage | _ClockMessage
_PAGE_MESSAGE: TypeAdapter[_PageMessage] = TypeAdapter(Annotated[_PageMessage, Field(discriminator="do")])


class PageHub:
    """Distributes frames to all connected pages; thread-safe."""

    def __init__(self, age: Callable[[Frame], float]) -> None:
        """`age` returns the age of a frame, ms."""
        self._age, self._lock = age, threading.Lock()
        self._pages: tuple[_Page, ...] = ()

    def show(self, frame: Frame) -> None:
        """Queue a frame for all pages."""
        for page in self._pages:
            page.loop.call_soon_threadsafe(page.offer, frame)

    def add(self, page: _Page) -> None:
        """Add a page."""
        with self._lock:
            self._pages = (*self._pages, page)

    def remove(self, page: _Page) -> None:
        """Remove a page."""
        with self._lock:
            self._pages = tuple(one for one in self._pages if one is not page)

    def encode(self, frame: Frame) -> bytes:
        """Encode a frame with its header."""
        captured = _now_ms() - self._age(frame)
        return FRAME_HEADER.pack(frame.camera, frame.key, frame.width, frame.height, captured) + frame.data


def _now_ms() -> float:
    """Time of the station's monotonic clock, ms."""
    return time.monotonic() * 1e3


class _Page:
    """A connected page, and its queue of frames; `driver`: who uses it, None: drivers have no names here."""

    def __init__(self, driver: Driver | None) -> None:
        self.driver, number = driver, next(_page_numbers)
        self.name = f"page {number}" if driver is None else f"{driver.name} (page {number})"
        self.loop = asyncio.get_running_loop()
        self._queue: deque[Frame] = deque()
        self._broken: set[int] = set()  # cameras that dropped a frame: later ones can't be decoded before a key frame
        self._frame_available = asyncio.Event()

    def offer(self, frame: Frame) -> None:
        """Queue a frame."""
        if len(self._queue) >= PAGE_QUEUE_MAX_FRAMES:
            self._broken |= {one.camera for one in self._queue}
            self._queue.clear()
        if frame.key:
            self._broken.discard(frame.camera)
        if frame.camera in self._broken:
            return
        self._queue.append(frame)
        self._frame_available.set()

    def require(self, role: DriverRole) -> None:
        """Check that its driver has a role.

        Raises:
            AccessError: the driver has not.
        """
        if self.driver is not None:
            self.driver.require(role)

    async def next(self) -> Frame:
        """Wait for the next frame."""
        while not self._queue:
            self._frame_available.clear()
            await self._frame_available.wait()
        return self._queue.popleft()


def application(
    served: ServerParams,
    station: Station,
    hub: PageHub,
    request_pair: Callable[[str, str, str], bool],
    drivers: Access | None = None,
    map_lines: Sequence[road_map.MapLine] = (),
) -> FastAPI:
    """The driver page and its API.

    Args:
        served: server settings.
        station: station of the page.
        hub: distributes the station's frames.
        request_pair: requests the gateway to join or to release a vehicle for a driver; False: it isn't connected.
        drivers: named drivers, who each have a token; None: anybody with the server's token.
        map_lines: map of the vehicle's world; empty: none is shown.

    Raises:
        InputError: the token can't be read.
    """
    app = protected("Teleoperation", served, {"station": station.alive}, drivers)
    road_map.add_route(app, map_lines)

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "cockpit.html")

    @app.get("/api/station")
    def station_state() -> dict[str, Any]:
        """State of station and vehicle."""
        return station.snapshot()

    @app.websocket("/live")
    async def live(web: WebSocket) -> None:
        token = factory.sent_token(web.scope) or ""
        driver = None if drivers is None else drivers.identify(token)
        await web.accept(subprotocol=factory.chosen_protocol(web.scope))
        page = _Page(driver)
        hub.add(page)
        tasks = [
            asyncio.create_task(_send_frames(web, page, hub)),
            asyncio.create_task(_send_state(web, page, station)),
            asyncio.create_task(_receive(web, page, station, request_pair)),
        ]
        if drivers is not None:
            tasks.append(asyncio.create_task(_until_revoked(driver, token, drivers)))
        why, revoked = "the page was closed", False
        try:
            station.request_key_frames()
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if revoked := drivers is not None and tasks[-1].done():
                why = "the driver's access was revoked"
        finally:
            station.driver_session.release(page.name, why)
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, Exception) and not isinstance(ended, WebSocketDisconnect):
                    log.error("%s: %r", page.name, ended, exc_info=ended)
            hub.remove(page)
        if revoked:
            await web.close(1008)

    return app


async def _until_revoked(driver: Driver | None, token: str, drivers: Access) -> None:
    """Return when a token isn't that of its driver, with the same role, any more."""
    while driver is not None and drivers.identify(token) == driver:
        await asyncio.sleep(REVOCATION_PERIOD_S)


async def _send_frames(web: WebSocket, page: _Page, hub: PageHub) -> None:
    while True:
        await web.send_bytes(hub.encode(await page.next()))


async def _send_state(web: WebSocket, page: _Page, station: Station) -> None:
    you = {"you": page.name, "role": None if page.driver is None else page.driver.role}
    while True:
        await web.send_text(json.dumps({"now_ms": _now_ms()} | station.snapshot() | you))
        await asyncio.sleep(STATUS_PERIOD_S)


async def _receive(
    web: WebSocket, page: _Page, station: Station, request_pair: Callable[[str, str, str], bool]
) -> None:
    while True:
        try:
            text = await web.receive_text()
        except WebSocketDisconnect:
            return
        if (answer := _handle(text, page, station, request_pair)) is not None:
            await web.send_text(json.dumps(answer))


def _handle(
    text: str, page: _Page, station: Station, request_pair: Callable[[str, str, str], bool]
) -> dict[str, Any] | None:
    """Carry out a message of a page; returns the answer: a time, or why the request was rejected."""
    try:
        message = _PAGE_MESSAGE.validate_json(text)
    except ValidationError as error:
        return {"fault": f"the message isn't valid: {error.errors()[0]['msg']}"}
    try:
        match message:
            case _LockMessage(do="take"):
                page.require(DriverRole.DRIVER)
                station.driver_session.acquire(page.name, time.monotonic())
            case _LockMessage():
                station.driver_session.release(page.name, message.why or "the driver released the controls")
            case _StopMessage(do="stop"):
                station.driver_session.latch(page.name)
            case _StopMessage():
                page.require(DriverRole.DRIVER)
                station.driver_session.unlatch(page.name)
            case _ControlsMessage():
                station.driver_session.update(page.name, message.command(), time.monotonic())
            case _PairMessage():
                page.require(DriverRole.OPERATOR)
                if not request_pair(message.do, message.vehicle, page.name):
                    return {"fault": "the gateway isn't connected"}
            case _KeyFrameMessage():
                if (joined := station.joined()) is not None:
                    joined.request_key_frame(message.camera)
            case _ClockMessage():
                return {"clock": message.sent, "now_ms": _now_ms()}
    except ScanError as error:
        return {"fault": str(error)}
    return None


def serve(params: StationParams, notify: Callable[[str], None], window: bool = False) -> None:
    """Run a station and its page until Ctrl-C; `notify` is called with progress messages; `window`: open a window.

    Raises:
        ScanError: the certificate or the world can't be read, the station can't listen, or no window can be opened.
    """
    if window:
        app_window.browser()
    drivers = access(params)
    map_lines = () if params.world is None else road_map.read(params.world)
    if params.world is not None and not map_lines:
        notify(f"{params.world} has no roads: the driver page shows no map")
    identity = Identity.read(params.certificates, Role.STATION)
    gateway = parse_address("GATEWAY", params.gateway, GATEWAY_PORT)
    listens = [parse_address("--listening", text, STATION_PORT) for text in params.listening]
    listener = Listener(identity, [(one.host, one.port) for one in listens])
    reached = [parse_address("--reached", text, STATION_PORT) for text in params.reached] or _reachable(
        listens, gateway
    )
    recorder: Recorder | None = None

    def show(frame: Frame) -> None:
        hub.show(frame)
        if recorder is not None and (joined := station.joined()) is not None:
            names = {one.camera: one.name for one in joined.streams.cameras}
            recorder.frame(names.get(frame.camera, ""), frame, joined.age(frame.captured))

    hub = PageHub(lambda frame: joined.age(frame.captured) if (joined := station.joined()) else 0.0)
    station = Station(identity, listener, reached, show)
    gateway_connection = GatewayConnection(identity, gateway, station, notify)
    station.report_event = gateway_connection.report_event
    with ExitStack() as stack:
        for one in (listener, station, gateway_connection):
            stack.callback(one.close)
        if params.record is not None:
            recorder = Recorder(params.record, params.record_limit * 1e9, station.snapshot, station.request_key_frames)
            record(station, recorder)
            stack.callback(recorder.close)
            notify(f"drives are recorded in {params.record}")

        def listening(url: str) -> None:
            notify(f"the driver page is {url}")
            if window:
                stack.enter_context(app_window.window(url))

        app = application(params, station, hub, partial(send_request, gateway_connection), drivers, map_lines)
        factory.run(app, params, listening)


def record(station: Station, recorder: Recorder) -> None:
    """Record a station's commands and events, in addition to reporting them."""
    report = station.report_event

    def report_and_record(event: DriverEvent) -> None:
        report(event)
        recorder.event(event.what, event.driver)

    station.report_event, station.record_command = report_and_record, recorder.command


def _reachable(listens: list[Address], gateway: Address) -> list[Address]:
    """Listening addresses as others reach them; a wildcard becomes the address of the route to the gateway."""
    addresses = []
    for one in listens:
        host = one.host
        if host in ("0.0.0.0", "::"):
            with socket.socket(socket.AF_INET6 if host == "::" else socket.AF_INET, socket.SOCK_DGRAM) as probe:
                try:
                    probe.connect((gateway.host, gateway.port))
                    host = probe.getsockname()[0]
                except OSError as error:
                    cause = f"can't be resolved or reached ({error.strerror or error})"
                    raise SettingError(f"{gateway.host}:{gateway.port}", cause, "Check the gateway's address") from None
        addresses.append(Address(host=host, port=one.port))
    return addresses
