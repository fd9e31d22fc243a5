"""Web service of the dashboard: plots of nodes, runs, queues and alarms, live in a browser (D3.2, chapter 3)."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import FastAPI, HTTPException, Query
from fastapi.responses import FileResponse, StreamingResponse
from numpy.typing import NDArray
from prometheus_client import Gauge
from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.services import kafka
from scan2sim.services.http import factory
from scan2sim.services.monitoring.dashboard.history import By, History, bucket_edges
from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events import alarm_commands
from scan2sim.services.monitoring.events.schema import AlarmCommand, Body
from scan2sim.services.monitoring.messages import Rejections
from scan2sim.services.monitoring.settings.bus import RuleName, Subject
from scan2sim.services.monitoring.settings.dashboard import PageParams
from scan2sim.services.supervision import SupervisedThread

log = logging.getLogger(__name__)

UPDATE_INTERVAL_S = 1.0
"""Pause between two server-sent events to a live page."""
RESENT_WINDOW_S = 15.0
"""Latest part of the window that is resent with every update, because records may arrive late."""
MIN_EVENT_HISTORY_S = 21_600.0
"""History of events that is read at least: runs and alarms last longer than records matter."""
MAX_WINDOW_S = 31 * 86_400
"""Longest time window of a request."""

Time = Annotated[float, Query(ge=0, le=1e11)]
Seconds = Annotated[float, Query(ge=1, le=MAX_WINDOW_S)]
Names = Annotated[list[str], Query(max_length=1000)]


class AlarmTarget(Body):
    """An alarm that someone acknowledges, or mutes for some seconds; 0 ends the muting."""

    rule: RuleName
    subject: Subject
    by: Annotated[str, Field(min_length=1, max_length=100)]
    seconds: Annotated[float, Field(ge=0, le=MAX_WINDOW_S)] = 3600.0


class NodeToRetire(Body):
    """A node that is gone for good, and who says so."""

    node: Subject
    by: Annotated[str, Field(min_length=1, max_length=100)]


class TopicReader:
    """Reads a Kafka topic in a background thread."""

    def __init__(
        self, cluster: kafka.Cluster, topic: str, history_s: float, callback: Callable[[bytes], None],
        rejections: Rejections,
    ) -> None:  # fmt: skip
        """Create it; `start` starts the thread.

        Args:
            cluster, topic: what to read.
            history_s: begin with the messages of the last `history_s` seconds.
            callback: called with every message.
            rejections: counts the messages that are skipped.
        """
        self._cluster, self._topic, self._callback, self._rejections = cluster, topic, callback, rejections
        self._since = time.time() - history_s
        self._thread = SupervisedThread(self._read, f"{topic} for the page")
        self._ended = threading.Event()
        self._connected = False

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._ended.set()
        self._thread.join(15.0)

    def is_alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def is_connected(self) -> bool:
        """Whether Kafka has assigned the topic to it."""
        return self._connected

    def _read(self) -> None:
        group = f"scan2sim-page-{uuid.uuid4().hex}"  # its own consumer group, so that every dashboard gets all messages
        bodies = kafka.read(
            self._cluster, self._topic, group=group, since=self._since, connected=self._set_connected, wait=0.5,
            rejected=self._rejections.add,
        )  # fmt: skip
        for body in bodies:
            if self._ended.is_set():
                return
            self._since = time.time()  # a restarted thread continues here
            if body is not None:
                kafka.process(body, self._callback, self._rejections.add)

    def _set_connected(self, connected: bool) -> None:
        if connected != self._connected:
            change = "connected to" if connected else "lost the connection to"
            log.warning("%s topic %s of Kafka at %s", change, self._topic, self._cluster.servers)
        self._connected = connected


@dataclass(frozen=True)
class Sources:
    """Data of the dashboard and the readers that fill it."""

    history: History
    bus_state: BusState
    records: TopicReader
    events: TopicReader

    @classmethod
    def of(cls, params: PageParams) -> Sources:
        """Create them empty; `start` starts the readers."""
        now, cluster = time.time(), kafka.Cluster.read(params.kafka_bootstrap_servers, params.kafka_config)
        history = History(now)
        bus_state = BusState(now, history.retire)
        back, events_back = params.back, max(MIN_EVENT_HISTORY_S, params.back)
        records = TopicReader(cluster, params.topic, back, history.add, history.rejections)
        events = TopicReader(cluster, params.events_topic, events_back, bus_state.add, bus_state.rejections)
        return cls(history, bus_state, records, events)

    def start(self) -> None:
        """Start both readers."""
        self.records.start()
        self.events.start()

    def close(self) -> None:
        """Stop both readers."""
        self.records.close()
        self.events.close()

    def is_connected(self) -> bool:
        """Whether Kafka has assigned one of the topics; the other is created when something is published on it."""
        return self.records.is_connected() or self.events.is_connected()


def application(params: PageParams, sources: Sources) -> FastAPI:
    """Web application with the page and its API.

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
    _register_metrics(app, sources)

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
            **sources.bus_state.state(now),
        }

    def send(command: AlarmCommand) -> dict[str, str]:
        """Send a command to the alarm node, and to all pages; returns when Kafka has taken it."""
        if params.is_open():
            raise HTTPException(403, "alarms are handled only with a token: start the page with --token FILE")
        cluster = kafka.Cluster.read(params.kafka_bootstrap_servers, params.kafka_config)
        if not alarm_commands.send_by_kafka(cluster, params.events_topic, command):
            cause = f"Kafka at {params.kafka_bootstrap_servers} doesn't take the command"
            raise UnavailableError(command.subject, cause, "Try again when the page is live")
        return {"sent": command.action}

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "bus.html")

    @app.get("/api/history")
    def past(
        begin: Annotated[float, Query(alias="from", ge=0, le=1e11)],
        to: Time,
        by: By = "node",
        nodes: Names = [],  # noqa: B006
        topics: Names = [],  # noqa: B006
    ) -> dict[str, Any]:
        """Statistics by node or topic between two times, seconds since the epoch, in buckets (`History.window`)."""
        if not 0 < to - begin <= MAX_WINDOW_S:
            raise SettingError("from, to", f"must be in order, up to {MAX_WINDOW_S} s apart", "Choose another range")
        return {"state": state(), **history.window(bucket_edges(begin, to), nodes if by == "node" else topics, by)}

    @app.get("/api/live")
    def live(
        seconds: Seconds = 300.0,
        by: By = "node",
        nodes: Names = [],  # noqa: B006
        topics: Names = [],  # noqa: B006
    ) -> StreamingResponse:
        """Server-sent events: the last `seconds`, then an update every second."""

        def window(edges: NDArray[np.float64]) -> dict[str, Any]:
            return history.window(edges, nodes if by == "node" else topics, by)

        return StreamingResponse(_events(window, state, seconds), media_type="text/event-stream")

    @app.post("/api/alarms/{action}")
    def command(action: Literal["acknowledge", "mute"], given: AlarmTarget) -> dict[str, str]:
        """Send a command about an alarm to the alarm node; answers when Kafka has taken it."""
        until = time.time() + given.seconds if action == "mute" else 0.0
        return send(AlarmCommand(action=action, rule=given.rule, subject=given.subject, by=given.by, until=until))

    @app.post("/api/nodes/retire")
    def retire(given: NodeToRetire) -> dict[str, str]:
        """Retire a node: its alarms end, and it isn't listed until it reports again; answers like alarms' commands."""
        return send(AlarmCommand(action="retire", subject=given.node, by=given.by))

    return app


async def _events(
    history_window: Callable[[NDArray[np.float64]], dict[str, Any]], state: Callable[[], dict[str, Any]], seconds: float
) -> AsyncIterator[str]:
    """First the whole window; then its latest buckets, which replace those of the same times, and changed runs."""
    since, versions = 0.0, dict[str, int]()
    while True:
        now = time.time()
        edges = bucket_edges(now - seconds, now)
        step = edges[1] - edges[0]
        window = await asyncio.to_thread(history_window, edges[edges >= since])
        current = state()
        for run in current["runs"]:
            if versions.get(run["run"]) == run["version"]:
                del run["details"]
        versions = {run["run"]: run["version"] for run in current["runs"]}
        yield f"data: {json.dumps({'state': current, 'begin': edges[0], **window})}\n\n"
        since = edges[-1] - max(2 * step, RESENT_WINDOW_S) - step
        await asyncio.sleep(UPDATE_INTERVAL_S)


def _register_metrics(app: FastAPI, sources: Sources) -> None:
    registry, history = app.state.registry, sources.history
    nodes = Gauge("scan2sim_page_nodes", "Nodes on the dashboard", registry=registry)
    nodes.set_function(lambda: len(history.state()["nodes"]))
    records = Gauge("scan2sim_page_records", "Records received since the start", ("shown",), registry=registry)
    records.labels("yes").set_function(lambda: history.shown)
    records.labels("no").set_function(history.rejections.counts.total)
    rejected = Gauge("scan2sim_page_events_rejected", "Events rejected since the start", registry=registry)
    rejected.set_function(sources.bus_state.rejections.counts.total)
    alarms = Gauge("scan2sim_page_alarms", "Raised alarms", registry=registry)
    alarms.set_function(lambda: len(sources.bus_state.alarms.state()["raised"]))


def serve(params: PageParams, notify: Callable[[str], None]) -> None:
    """Serve the dashboard until Ctrl-C; `notify` is called with messages for the user.

    Raises:
        SettingError: it can't listen on the address or port.
        InputError: the token, certificate or key can't be read.
    """
    sources = Sources.of(params)
    app = application(params, sources)

    def listening(address: str) -> None:
        topics = f"{params.topic} and {params.events_topic}"
        notify(f"dashboard of {topics} on {params.kafka_bootstrap_servers}: {address} (stop with Ctrl-C)")

    sources.start()
    try:
        factory.run(app, params, listening)
    finally:
        sources.close()
