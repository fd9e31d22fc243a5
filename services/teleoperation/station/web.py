"""The station's page: pictures, how old they are, and the wheel; one WebSocket each (D3.2, section 4.3).

To the page: facts as JSON twenty times a second, and each picture as it came (VP8: browsers decode it) behind a header.
From it: JSON, `{"do": "take" | "leave" | "turn" | "join" | "release" | "key" | "clock", ...}`.

Pictures and facts carry a time of the station's monotonic clock, which the page compares with its own (`clock`): so the
page knows the age of whatever arrives, also after it lay in a queue or in a process that was stopped.
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
from scan2sim.services.http.settings import Served
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.gateway.client import Membership
from scan2sim.services.teleoperation.gateway.identity import Identity, Role
from scan2sim.services.teleoperation.gateway.protocol import Address
from scan2sim.services.teleoperation.settings import GATEWAY, STATION, StationParams, address
from scan2sim.services.teleoperation.station import app_window
from scan2sim.services.teleoperation.station.app import Station, ask
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.video.jitter_buffer import Frame

log = logging.getLogger(__name__)

HEADER = struct.Struct("<BBHHd")
"""Before a picture: camera, whether it is a key frame, width, height, time of capture (ms of the station's clock)."""
FACTS = 0.05
"""Seconds between two tellings of facts."""
WAITING = 24
"""Pictures that may wait for a page; one that falls behind is shown the newest key frame next."""
_names = itertools.count(1)


class _Take(BaseModel):
    do: Literal["take", "leave"]
    why: Annotated[str, Field(max_length=100)] = ""


class _Turn(BaseModel):
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


class _Fetch(BaseModel):
    do: Literal["join", "release"]
    vehicle: Annotated[str, Field(min_length=1, max_length=60)]


class _Key(BaseModel):
    do: Literal["key"]
    camera: Annotated[int, Field(ge=0, le=255)]


class _Clock(BaseModel):
    do: Literal["clock"]
    sent: Annotated[float, Field(allow_inf_nan=False)]
    """Time on the page's clock, which the answer returns."""


_Said = _Take | _Turn | _Fetch | _Key | _Clock
_SAID: TypeAdapter[_Said] = TypeAdapter(Annotated[_Said, Field(discriminator="do")])


class Screens:
    """Pages that watch; frames are handed to it in any thread, each page takes them in the server's."""

    def __init__(self, age: Callable[[Frame], float]) -> None:
        """`age`: of a frame in ms."""
        self._age, self._lock = age, threading.Lock()
        self._pages: tuple[_Page, ...] = ()

    def show(self, frame: Frame) -> None:
        """Have all pages show it."""
        for page in self._pages:
            page.loop.call_soon_threadsafe(page.offer, frame)

    def add(self, page: _Page) -> None:
        """A page watches from now on."""
        with self._lock:
            self._pages = (*self._pages, page)

    def remove(self, page: _Page) -> None:
        """It watches no more."""
        with self._lock:
            self._pages = tuple(one for one in self._pages if one is not page)

    def packed(self, frame: Frame) -> bytes:
        """As pages take it."""
        captured = _now_ms() - self._age(frame)
        return HEADER.pack(frame.camera, frame.key, frame.width, frame.height, captured) + frame.data


def _now_ms() -> float:
    """Milliseconds of the station's monotonic clock."""
    return time.monotonic() * 1e3


class _Page:
    """One page: what waits to be sent to it."""

    def __init__(self) -> None:
        self.name = f"page {next(_names)}"
        self.loop = asyncio.get_running_loop()
        self._waiting: deque[Frame] = deque()
        self._broken: set[int] = set()  # cameras of which a picture was left out: the next is no use before a key frame
        self._some = asyncio.Event()

    def offer(self, frame: Frame) -> None:
        """Have it wait."""
        if len(self._waiting) >= WAITING:
            self._broken |= {one.camera for one in self._waiting}
            self._waiting.clear()
        if frame.key:
            self._broken.discard(frame.camera)
        if frame.camera in self._broken:
            return
        self._waiting.append(frame)
        self._some.set()

    async def next(self) -> Frame:
        """The one that has waited longest."""
        while not self._waiting:
            self._some.clear()
            await self._some.wait()
        return self._waiting.popleft()


def application(served: Served, station: Station, screens: Screens, fetch: Callable[[str, str], bool]) -> FastAPI:
    """The page, and what it talks to.

    Args:
        served: how it listens.
        station: whose page it is.
        screens: where the station's pictures go.
        fetch: asks the gateway to join a vehicle, or to release it; False: it isn't reached.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application("Teleoperation", served, alive={"station": station.alive}, public=("/",))

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "cockpit.html")

    @app.get("/api/station")
    def facts() -> dict[str, Any]:
        """How station and vehicle are."""
        return station.facts()

    @app.websocket("/live")
    async def live(web: WebSocket) -> None:
        await web.accept(subprotocol=factory.chosen_protocol(web.scope))
        watching = _Page()
        screens.add(watching)
        tasks = [
            asyncio.create_task(_pictures(web, watching, screens)),
            asyncio.create_task(_facts(web, watching, station)),
            asyncio.create_task(_obey(web, watching, station, fetch)),
        ]
        try:
            if (joined := station.joined()) is not None:
                for camera in joined.streams.cameras:
                    joined.want(camera.camera)
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, Exception) and not isinstance(ended, WebSocketDisconnect):
                    log.error("%s: %r", watching.name, ended, exc_info=ended)
            screens.remove(watching)
            station.wheel.leave(watching.name, "the page was closed")

    return app


async def _pictures(web: WebSocket, page: _Page, screens: Screens) -> None:
    while True:
        await web.send_bytes(screens.packed(await page.next()))


async def _facts(web: WebSocket, page: _Page, station: Station) -> None:
    while True:
        await web.send_text(json.dumps({"now_ms": _now_ms()} | station.facts() | {"you": page.name}))
        await asyncio.sleep(FACTS)


async def _obey(web: WebSocket, page: _Page, station: Station, fetch: Callable[[str, str], bool]) -> None:
    while True:
        try:
            text = await web.receive_text()
        except WebSocketDisconnect:
            return
        if (answer := _done(text, page, station, fetch)) is not None:
            await web.send_text(json.dumps(answer))


def _done(text: str, page: _Page, station: Station, fetch: Callable[[str, str], bool]) -> dict[str, Any] | None:
    """Do what a page wants; the answer: the time, or why it isn't done."""
    try:
        said = _SAID.validate_json(text)
    except ValidationError as error:
        return {"fault": f"that can't be understood: {error.errors()[0]['msg']}"}
    try:
        match said:
            case _Take(do="take"):
                station.wheel.take(page.name, time.monotonic())
            case _Take():
                station.wheel.leave(page.name, said.why or "the driver left it")
            case _Turn():
                station.wheel.turn(page.name, said.command(), time.monotonic())
            case _Fetch():
                if not fetch(said.do, said.vehicle):
                    return {"fault": "the gateway isn't reached"}
            case _Key():
                if (joined := station.joined()) is not None:
                    joined.want(said.camera)
            case _Clock():
                return {"clock": said.sent, "now_ms": _now_ms()}
    except ScanError as error:
        return {"fault": str(error)}
    return None


def serve(params: StationParams, say: Callable[[str], None], window: bool = False) -> None:
    """Be a station, and serve its page, until Ctrl-C; `say` is told what happens; `window`: the page has one.

    Raises:
        ScanError: its certificate can't be read, it can't listen, or there can be no window.
    """
    if window:
        app_window.browser()
    identity = Identity.read(params.certificates, Role.STATION)
    gateway = address("GATEWAY", params.gateway, GATEWAY)
    listens = [address("--listening", text, STATION) for text in params.listening]
    listener = Listener(identity, [(one.host, one.port) for one in listens])
    reached = [address("--reached", text, STATION) for text in params.reached] or _seen(listens, gateway)
    screens = Screens(lambda frame: joined.age(frame.captured) if (joined := station.joined()) else 0.0)
    station = Station(identity, listener, reached, screens.show)
    membership = Membership(identity, gateway, station, say)
    with ExitStack() as stack:
        for one in (listener, station, membership):
            stack.callback(one.close)

        def listening(url: str) -> None:
            say(f"the driver's page is {url}")
            if window:
                stack.enter_context(app_window.window(url))

        app = application(params, station, screens, lambda what, vehicle: ask(membership, what, vehicle))
        factory.run(app, params, listening)


def _seen(listens: list[Address], gateway: Address) -> list[Address]:
    """Where it listens, as others see it: an address of any is the one that leads to the gateway."""
    found = []
    for one in listens:
        host = one.host
        if host in ("0.0.0.0", "::"):
            with socket.socket(socket.AF_INET6 if host == "::" else socket.AF_INET, socket.SOCK_DGRAM) as probe:
                try:
                    probe.connect((gateway.host, gateway.port))
                    host = probe.getsockname()[0]
                except OSError as error:
                    cause = f"isn't found from here ({error.strerror or error})"
                    raise SettingError(f"{gateway.host}:{gateway.port}", cause, "Name the gateway's host") from None
        found.append(Address(host=host, port=one.port))
    return found
