"""The live page of the event bus: what nodes tell by Kafka, as six plots, in a browser (D3.2, chapter 3)."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import FileResponse, StreamingResponse
from prometheus_client import Gauge

from scan2sim.pipeline.errors import SettingError
from scan2sim.services import kafka, serving
from scan2sim.services.monitoring.history import History, grid
from scan2sim.services.monitoring.shown import PageParams

log = logging.getLogger(__name__)

TICK = 1.0
"""Seconds between two messages to a live page."""
TOLD_AGAIN = 15.0
"""Seconds whose buckets a live page is told again: records come late."""
LONGEST = 31 * 86_400
"""Seconds of a window, at most."""

Time = Annotated[float, Query(ge=0, le=1e11)]
Seconds = Annotated[float, Query(ge=1, le=LONGEST)]
Names = Annotated[list[str], Query(max_length=1000)]


class Reader:
    """Reads records of a topic of Kafka into a history, in a thread of its own."""

    def __init__(self, params: PageParams, history: History) -> None:
        self._params, self._history = params, history
        self._thread = threading.Thread(target=self._read, name="records of the page", daemon=True)
        self._ended = threading.Event()
        self._connected = False

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._ended.set()
        self._thread.join(15.0)

    def is_alive(self) -> bool:
        """Whether it goes on reading."""
        return self._thread.is_alive()

    def is_connected(self) -> bool:
        """Whether Kafka has given it the topic."""
        return self._connected

    def _read(self) -> None:
        servers, topic = self._params.kafka_bootstrap_servers, self._params.topic
        since = time.time() - self._params.back
        group = f"scan2sim-page-{uuid.uuid4().hex}"  # its own: every page reads all
        for body in kafka.read(servers, topic, group=group, since=since, connected=self._connect, wait=0.5):
            if self._ended.is_set():
                return
            if body is not None:
                self._history.take(body)

    def _connect(self, connected: bool) -> None:
        if connected != self._connected:
            log.warning("Kafka at %s %s", self._params.kafka_bootstrap_servers, "is there" if connected else "is gone")
        self._connected = connected


def application(params: PageParams, history: History, reader: Reader) -> FastAPI:
    """The page, and what it asks for.

    Raises:
        InputError: the token can't be read.
    """
    app = serving.application(
        "The event bus",
        params,
        alive={"reader": reader.is_alive},
        ready={"Kafka": reader.is_connected},
        public=("/",),
    )
    _tell_counts(app, history)

    def state() -> dict[str, Any]:
        return {
            "topic": params.topic,
            "servers": params.kafka_bootstrap_servers,
            "connected": reader.is_connected(),
            "limits": params.limit.model_dump(exclude_none=True),
            "now": time.time(),
            **history.state(),
        }

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(serving.PAGES / "bus.html")

    @app.get("/api/history")
    def past(
        begin: Annotated[float, Query(alias="from", ge=0, le=1e11)],
        to: Time,
        nodes: Names = [],  # noqa: B006
    ) -> dict[str, Any]:
        """What nodes did between two times, seconds since the epoch, in buckets (`History.window`)."""
        if not 0 < to - begin <= LONGEST:
            raise SettingError("from, to", f"must be in order, up to {LONGEST} s apart", "Choose another range")
        return {"state": state(), **history.window(grid(begin, to), nodes)}

    @app.get("/api/live")
    def live(seconds: Seconds = 300.0, nodes: Names = []) -> StreamingResponse:  # noqa: B006
        """The last so many seconds, then once a second what is new: server-sent events."""
        return StreamingResponse(_events(history, state, seconds, nodes), media_type="text/event-stream")

    return app


async def _events(
    history: History, state: Callable[[], dict[str, Any]], seconds: float, nodes: list[str]
) -> AsyncIterator[str]:
    """First the whole window; then its last buckets, which replace those that the page has of the same times."""
    since = 0.0
    while True:
        now = time.time()
        edges = grid(now - seconds, now)
        step = edges[1] - edges[0]
        window = await asyncio.to_thread(history.window, edges[edges >= since], nodes)
        yield f"data: {json.dumps({'state': state(), 'begin': edges[0], **window})}\n\n"
        since = edges[-1] - max(2 * step, TOLD_AGAIN) - step
        await asyncio.sleep(TICK)


def _tell_counts(app: FastAPI, history: History) -> None:
    registry = app.state.registry
    nodes = Gauge("scan2sim_page_nodes", "Nodes that the page shows", registry=registry)
    nodes.set_function(lambda: len(history.state()["nodes"]))
    records = Gauge("scan2sim_page_records", "Records since the page began", ("shown",), registry=registry)
    records.labels("yes").set_function(lambda: history.counts["shown"])
    records.labels("no").set_function(lambda: history.counts.total() - history.counts["shown"])


def serve(params: PageParams, told: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C; `told` is told what a user is to know.

    Raises:
        SettingError: it can't listen where it is to.
        InputError: token, certificate or key can't be read.
    """
    history = History(time.time())
    reader = Reader(params, history)
    app = application(params, history, reader)

    def listening(address: str) -> None:
        told(f"{address} shows {params.topic} of {params.kafka_bootstrap_servers}; Ctrl-C ends it")
        if params.is_open():
            told("whoever reaches this machine can read it: --token FILE asks for one")

    reader.start()
    try:
        serving.run(app, params, listening)
    finally:
        reader.close()
