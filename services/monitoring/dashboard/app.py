"""The live page of the event bus, in a browser: nodes as six plots, runs and alarms (D3.2, chapter 3)."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import FileResponse, StreamingResponse
from prometheus_client import Gauge

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import kafka
from scan2sim.services.http import factory
from scan2sim.services.monitoring.dashboard.history import History, grid
from scan2sim.services.monitoring.dashboard.state import Noticed
from scan2sim.services.monitoring.settings.dashboard import PageParams

log = logging.getLogger(__name__)

TICK = 1.0
"""Seconds between two messages to a live page."""
TOLD_AGAIN = 15.0
"""Seconds whose buckets a live page is told again: records come late."""
EVENTS_BACK = 21_600.0
"""Seconds before its start from which it shows runs and alarms, at least: they last."""
LONGEST = 31 * 86_400
"""Seconds of a window, at most."""

Time = Annotated[float, Query(ge=0, le=1e11)]
Seconds = Annotated[float, Query(ge=1, le=LONGEST)]
Names = Annotated[list[str], Query(max_length=1000)]


class Reader:
    """Reads a topic of Kafka, in a thread of its own."""

    def __init__(self, servers: str, topic: str, back: float, take: Callable[[bytes], None]) -> None:
        """Have `take` called with what comes, and came in the last `back` seconds."""
        self._servers, self._topic, self._back, self._take = servers, topic, back, take
        self._thread = threading.Thread(target=self._read, name=f"{topic} for the page", daemon=True)
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
        since = time.time() - self._back
        group = f"scan2sim-page-{uuid.uuid4().hex}"  # its own: every page reads all
        read = kafka.read(self._servers, self._topic, group=group, since=since, connected=self._connect, wait=0.5)
        for body in read:
            if self._ended.is_set():
                return
            if body is not None:
                self._take(body)

    def _connect(self, connected: bool) -> None:
        if connected != self._connected:
            log.warning("Kafka at %s %s %s", self._servers, "gives" if connected else "no longer gives", self._topic)
        self._connected = connected


@dataclass(frozen=True)
class Sources:
    """What the page shows, and who reads it."""

    history: History
    noticed: Noticed
    records: Reader
    events: Reader

    @classmethod
    def of(cls, params: PageParams) -> Sources:
        """Empty ones; `start` has them filled."""
        now, servers = time.time(), params.kafka_bootstrap_servers
        history, noticed = History(now), Noticed(now)
        events = Reader(servers, params.events_topic, max(EVENTS_BACK, params.back), noticed.take)
        return cls(history, noticed, Reader(servers, params.topic, params.back, history.take), events)

    def start(self) -> None:
        """Begin to read."""
        self.records.start()
        self.events.start()

    def close(self) -> None:
        """Read no more."""
        self.records.close()
        self.events.close()

    def is_connected(self) -> bool:
        """Whether Kafka has given one of the topics; the other comes with the first who sends to it."""
        return self.records.is_connected() or self.events.is_connected()


def application(params: PageParams, sources: Sources) -> FastAPI:
    """The page, and what it asks for.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application(
        "The event bus",
        params,
        alive={"records": sources.records.is_alive, "events": sources.events.is_alive},
        ready={"Kafka": sources.is_connected},
        public=("/",),
    )
    history = sources.history
    _count(app, sources)

    def state() -> dict[str, Any]:
        now = time.time()
        return {
            "topic": params.topic,
            "events_topic": params.events_topic,
            "servers": params.kafka_bootstrap_servers,
            "connected": sources.is_connected(),
            "limits": params.limit.model_dump(exclude_none=True),
            "now": now,
            **history.state(),
            **sources.noticed.state(now),
        }

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "bus.html")

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
    """First all; then the window's last buckets, which replace those of the same times, and runs that have changed."""
    since, versions = 0.0, dict[str, int]()
    while True:
        now = time.time()
        edges = grid(now - seconds, now)
        step = edges[1] - edges[0]
        window = await asyncio.to_thread(history.window, edges[edges >= since], nodes)
        told = state()
        for run in told["runs"]:
            if versions.get(run["run"]) == run["version"]:
                del run["details"]
        versions = {run["run"]: run["version"] for run in told["runs"]}
        yield f"data: {json.dumps({'state': told, 'begin': edges[0], **window})}\n\n"
        since = edges[-1] - max(2 * step, TOLD_AGAIN) - step
        await asyncio.sleep(TICK)


def _count(app: FastAPI, sources: Sources) -> None:
    registry, history = app.state.registry, sources.history
    nodes = Gauge("scan2sim_page_nodes", "Nodes that the page shows", registry=registry)
    nodes.set_function(lambda: len(history.state()["nodes"]))
    records = Gauge("scan2sim_page_records", "Records since the page began", ("shown",), registry=registry)
    records.labels("yes").set_function(lambda: history.counts["shown"])
    records.labels("no").set_function(lambda: history.counts.total() - history.counts["shown"])
    refused = Gauge("scan2sim_page_events_refused", "Events since the page began that were none", registry=registry)
    refused.set_function(sources.noticed.counts.total)
    alarms = Gauge("scan2sim_page_alarms", "Alarms that are raised", registry=registry)
    alarms.set_function(lambda: len(sources.noticed.alarms.state()["raised"]))


def serve(params: PageParams, told: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C; `told` is told what a user is to know.

    Raises:
        SettingError: it can't listen where it is to.
        InputError: token, certificate or key can't be read.
    """
    sources = Sources.of(params)
    app = application(params, sources)

    def listening(address: str) -> None:
        topics = f"{params.topic} and {params.events_topic}"
        told(f"{address} shows {topics} of {params.kafka_bootstrap_servers}; Ctrl-C ends it")

    sources.start()
    try:
        factory.run(app, params, listening)
    finally:
        sources.close()
