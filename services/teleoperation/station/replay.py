"""Replay of a recorded drive on the driver page: pictures and states have their recorded ages; nothing is driven."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse

from scan2sim.services.http import factory
from scan2sim.services.teleoperation.settings import ReplayParams
from scan2sim.services.teleoperation.station import road_map
from scan2sim.services.teleoperation.station.recorder import RecordedFrame, read
from scan2sim.services.teleoperation.station.web import FRAME_HEADER

PAUSE_S = 1.0
"""Pause before a recording is replayed again."""


def application(params: ReplayParams) -> FastAPI:
    """The driver page with a recorded drive.

    Raises:
        InputError: the recording, the token or the world can't be read.
    """
    next(read(params.recording))  # a missing recording is an error at once
    app = factory.application("Replay", params, alive={}, public=("/",))
    road_map.add_route(app, () if params.world is None else road_map.read(params.world))

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "cockpit.html")

    @app.get("/api/station")
    def station_state() -> dict[str, Any]:
        """What is replayed."""
        return {"recording": str(params.recording)}

    @app.websocket("/live")
    async def live(web: WebSocket) -> None:
        await web.accept(subprotocol=factory.chosen_protocol(web.scope))
        tasks = [asyncio.create_task(_send(web, params)), asyncio.create_task(_receive(web))]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    return app


async def _send(web: WebSocket, params: ReplayParams) -> None:
    while True:
        began, first, numbers = time.monotonic(), None, dict[str, int]()
        for message in read(params.recording):
            first = message.at if first is None else first
            await asyncio.sleep(began + (message.at - first) / 1e9 / params.speed - time.monotonic())
            now_ms, content = time.monotonic() * 1e3, message.content
            if message.topic == "/state":
                numbers |= {one["name"]: one["camera"] for one in content.get("cameras", ())}
                driver = content.get("driver") or "nobody"
                shown = {"you": "replay", "driver": None, "left": f"This is a recorded drive; driver: {driver}"}
                await web.send_text(json.dumps(content | shown | {"now_ms": now_ms}))
            elif isinstance(content, RecordedFrame):
                captured = now_ms - (message.at - content.captured) / 1e6
                head = FRAME_HEADER.pack(numbers.get(content.camera, 0), content.key, 0, 0, captured)
                await web.send_bytes(head + content.data)
        await asyncio.sleep(PAUSE_S)


async def _receive(web: WebSocket) -> None:
    with suppress(WebSocketDisconnect):
        while True:
            message = json.loads(await web.receive_text())
            if message.get("do") == "clock":
                answer = {"clock": message.get("sent"), "now_ms": time.monotonic() * 1e3}
                await web.send_text(json.dumps(answer))
            elif message.get("do") in ("take", "join", "release", "stop"):
                await web.send_text(json.dumps({"fault": "this is a recorded drive: nothing is driven"}))


def serve(params: ReplayParams, notify: Callable[[str], None]) -> None:
    """Replay on a page until Ctrl-C; `notify` is called with its URL.

    Raises:
        ScanError: the recording can't be read, or the page can't be served.
    """
    factory.run(application(params), params, lambda url: notify(f"the recorded drive is replayed at {url}"))
