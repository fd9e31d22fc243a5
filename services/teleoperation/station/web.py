"""The driver page of a station: video, its latency, and driving; one WebSocket for each page (D3.2, section 4.3).

To the page: the state as JSON twenty times a second, and each frame behind a header (VP8, decoded by the browser).
From the page: JSON, `{"do": "take" | "leave" | "turn" | "join" | "release" | "key" | "clock", ...}`.

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
from collections.abc import Callable
from contextlib import ExitStack
from typing import Annotated, Any, Literal

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway_protocol import Address
from scan2sim.services.teleoperation.identity import Identity, Role
from scan2sim.services.teleoperation.settings import GATEWAY_PORT, STATION_PORT, StationParams, parse_address
from scan2sim.services.teleoperation.station import app_window
from scan2sim.services.teleoperation.station.app import Station, send_request
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.video.jitter_buffer import Frame

log = logging.getLogger(__name__)

FRAME_HEADER = struct.Struct("<BBHHd")
"""Header of a frame: camera, key frame flag, width, height, capture time (ms of the station's monotonic clock)."""
STATUS_PERIOD_S = 0.05
"""Interval between two state messages."""
PAGE_QUEUE_MAX_FRAMES = 24
"""Maximum number of frames queued for a page; a page that falls behind continues with the next key frame."""
_page_numbers = itertools.count(1)


class _LockMessage(BaseModel):
    do: Literal["take", "leave"]
    why: Annotated[str, Field(max_length=100)] = ""


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


_PageMessage = _LockMessage | _ControlsMessage | _PairMessage | _KeyFrameMessage | _ClockMessage
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
    """A connected page, and its queue of frames."""

    def __init__(self) -> None:
        self.name = f"page {next(_page_numbers)}"
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

    async def next(self) -> Frame:
        """Wait for the next frame."""
        while not self._queue:
            self._frame_available.clear()
            await self._frame_available.wait()
        return self._queue.popleft()


def application(
    served: ServerParams, station: Station, hub: PageHub, request_pair: Callable[[str, str], bool]
) -> FastAPI:
    """The driver page and its API.

    Args:
        served: server settings.
        station: station of the page.
        hub: distributes the station's frames.
        request_pair: requests the gateway to join or to release a vehicle; False: the gateway isn't connected.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application("Teleoperation", served, alive={"station": station.alive}, public=("/",))

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "cockpit.html")

    @app.get("/api/station")
    def station_state() -> dict[str, Any]:
        """State of station and vehicle."""
        return station.snapshot()

    @app.websocket("/live")
    async def live(web: WebSocket) -> None:
        await web.accept(subprotocol=factory.chosen_protocol(web.scope))
        page = _Page()
        hub.add(page)
        tasks = [
            asyncio.create_task(_send_frames(web, page, hub)),
            asyncio.create_task(_send_state(web, page, station)),
            asyncio.create_task(_receive(web, page, station, request_pair)),
        ]
        try:
            if (joined := station.joined()) is not None:
                for camera in joined.streams.cameras:
                    joined.request_key_frame(camera.camera)
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, Exception) and not isinstance(ended, WebSocketDisconnect):
                    log.error("%s: %r", page.name, ended, exc_info=ended)
            hub.remove(page)
            station.driver_session.release(page.name, "the page was closed")

    return app


async def _send_frames(web: WebSocket, page: _Page, hub: PageHub) -> None:
    while True:
        await web.send_bytes(hub.encode(await page.next()))


async def _send_state(web: WebSocket, page: _Page, station: Station) -> None:
    while True:
        await web.send_text(json.dumps({"now_ms": _now_ms()} | station.snapshot() | {"you": page.name}))
        await asyncio.sleep(STATUS_PERIOD_S)


async def _receive(web: WebSocket, page: _Page, station: Station, request_pair: Callable[[str, str], bool]) -> None:
    while True:
        try:
            text = await web.receive_text()
        except WebSocketDisconnect:
            return
        if (answer := _handle(text, page, station, request_pair)) is not None:
            await web.send_text(json.dumps(answer))


def _handle(
    text: str, page: _Page, station: Station, request_pair: Callable[[str, str], bool]
) -> dict[str, Any] | None:
    """Carry out a message of a page; returns the answer: a time, or why the request was refused."""
    try:
        message = _PAGE_MESSAGE.validate_json(text)
    except ValidationError as error:
        return {"fault": f"the message isn't valid: {error.errors()[0]['msg']}"}
    try:
        match message:
            case _LockMessage(do="take"):
                station.driver_session.acquire(page.name, time.monotonic())
            case _LockMessage():
                station.driver_session.release(page.name, message.why or "the driver released the controls")
            case _ControlsMessage():
                station.driver_session.update(page.name, message.command(), time.monotonic())
            case _PairMessage():
                if not request_pair(message.do, message.vehicle):
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
        ScanError: the certificate can't be read, the station can't listen, or no window can be opened.
    """
    if window:
        app_window.browser()
    identity = Identity.read(params.certificates, Role.STATION)
    gateway = parse_address("GATEWAY", params.gateway, GATEWAY_PORT)
    listens = [parse_address("--listening", text, STATION_PORT) for text in params.listening]
    listener = Listener(identity, [(one.host, one.port) for one in listens])
    reached = [parse_address("--reached", text, STATION_PORT) for text in params.reached] or _reachable(
        listens, gateway
    )
    hub = PageHub(lambda frame: joined.age(frame.captured) if (joined := station.joined()) else 0.0)
    station = Station(identity, listener, reached, hub.show)
    gateway_connection = GatewayConnection(identity, gateway, station, notify)
    with ExitStack() as stack:
        for one in (listener, station, gateway_connection):
            stack.callback(one.close)

        def listening(url: str) -> None:
            notify(f"the driver page is {url}")
            if window:
                stack.enter_context(app_window.window(url))

        app = application(params, station, hub, lambda what, vehicle: send_request(gateway_connection, what, vehicle))
        factory.run(app, params, listening)


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
