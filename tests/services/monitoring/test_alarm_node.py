"""The alarm node as a process: an outage of the broker, kills and restarts, notifications, commands of people."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Iterator
from email.message import EmailMessage
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from aiosmtpd.controller import Controller

from scan2sim.services import kafka
from tests.fakes.broker import Broker
from tests.fakes.nodes import end, wait_until_ready
from tests.fakes.ports import free_dds_domain, free_port
from tests.services.conftest import Start
from tests.waiting import until

CLI = ("cyclone", "-m", "scan2sim.flows.cli", "monitor")
RULES = """
[[rules]]
name = "silent"
metric = "silence"
above = 6

[notify]
webhook = "http://127.0.0.1:{http}/alarms?token=secret"
email = ["operator@example.com"]
smtp = "127.0.0.1:{smtp}"
"""
WAIT_S = 60.0


class Webhook(HTTPServer):
    """Receives notifications; answers 503 to the first request."""

    def __init__(self) -> None:
        self.received: queue.Queue[dict[str, Any]] = queue.Queue()
        received, ids, refused = self.received, set[str](), threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                if not refused.is_set():
                    refused.set()
                    self.send_error(503)
                    return
                if self.headers["Idempotency-Key"] not in ids:
                    ids.add(self.headers["Idempotency-Key"])
                    received.put(body)
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()


class Mailbox:
    """Handler of a real SMTP server (aiosmtpd)."""

    def __init__(self) -> None:
        self.subjects: list[str] = []

    async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
        from email import message_from_bytes, policy

        mail = message_from_bytes(envelope.content, policy=policy.default)
        assert isinstance(mail, EmailMessage) and envelope.rcpt_tos == ["operator@example.com"]
        self.subjects.append(str(mail["Subject"]))
        return "250 OK"


@pytest.fixture
def webhook() -> Iterator[Webhook]:
    server = Webhook()
    yield server
    server.shutdown()


@pytest.fixture
def mailbox() -> Iterator[tuple[Mailbox, int]]:
    handler, port = Mailbox(), free_port()
    controller = Controller(handler, hostname="127.0.0.1", port=port, ready_timeout=WAIT_S)
    controller.start()
    yield handler, port
    controller.stop()


def next_of(received: queue.Queue[Any]) -> Any:
    return received.get(timeout=WAIT_S)


def next_about(subject: str, received: queue.Queue[Any]) -> Any:
    """Next notification about a subject; a busy machine may find Kafka slow meanwhile, but no other node is silent."""
    while (found := next_of(received))["subject"] == "Kafka":
        continue
    assert found["subject"] == subject
    return found


@pytest.mark.realtime
def test_alarms_survive_outage_kill_and_restart_once(
    start: Start, broker: Broker, webhook: Webhook, mailbox: tuple[Mailbox, int], tmp_path: Path
) -> None:
    mails, port = mailbox
    rules = tmp_path / "rules.toml"
    rules.write_text(RULES.format(http=webhook.server_port, smtp=port), encoding="utf-8")
    apart = {"ROS_DOMAIN_ID": str(free_dds_domain())}  # the alarm node hears the others by Kafka only

    def alarm_node() -> Any:
        return start(*CLI, "alarms", rules, "--kafka", broker.servers, **apart)

    def talker(name: str) -> Any:
        return start(*CLI, "talker", f"/{name}", "--name", name, "--kafka", broker.servers)

    alarms, stays, _ = alarm_node(), talker("stays"), talker("leaves")
    wait_until_ready(alarms)
    _wait_until_heard(tmp_path / "state" / "scan2sim" / "alarms" / "rules.json", {"/stays", "/leaves"})
    killed = time.time()
    broker.kill()
    while (outage := next_of(webhook.received))["since"] < killed:  # a busy machine may find Kafka slow at first
        assert outage["subject"] == "Kafka"
    assert (outage["state"], outage["rule"], outage["subject"]) == ("raised", "Kafka is unreachable", "Kafka")
    broker.start()
    assert next_of(webhook.received)["text"].startswith("cleared Kafka is unreachable: Kafka")

    _wait_for_records(broker, {"stays", "leaves"})  # the alarm node may not have been assigned the topic again
    stays.kill()
    silent = next_of(webhook.received)
    assert (silent["state"], silent["subject"]) == ("raised", "/stays")
    alarms.kill()
    alarms.wait()
    alarms = alarm_node()
    wait_until_ready(alarms)  # from now on it misses no command
    command = start(*CLI, "acknowledge", "silent", "/stays", "--by", "Ada", "--kafka", broker.servers)
    output, errors = end(command)
    assert command.returncode == 0 and output == "sent to the alarm node\n", errors
    acknowledged = next_about("/stays", webhook.received)
    assert acknowledged["acknowledged_by"] == "Ada" and acknowledged["state"] == "raised"
    talker("stays")
    assert next_about("/stays", webhook.received)["state"] == "cleared"
    time.sleep(3.0)
    later = [webhook.received.get_nowait() for _ in range(webhook.received.qsize())]
    assert [one for one in later if one["subject"] != "Kafka"] == []
    until(lambda: any("cleared silent: /stays" in one for one in mails.subjects), state=lambda: mails.subjects)
    assert mails.subjects[0].startswith("[scan2sim] raised Kafka is unreachable") and len(mails.subjects) >= 5
    assert sum("raised silent: /stays" in one and "Ada" not in one for one in mails.subjects) == 1
    alarms.terminate()
    _, errors = end(alarms)
    assert "secret" not in errors and "Traceback" not in errors


def _wait_until_heard(state: Path, nodes: set[str]) -> None:
    """Wait until an alarm node has heard nodes, and found Kafka reachable, by its state file (saved every 10 s)."""

    def saved() -> dict[str, Any]:
        content = json.loads(state.read_text(encoding="utf-8")) if state.exists() else {}
        return {"nodes": {}, "alarms": []} | content

    def has_heard() -> bool:
        return nodes <= set(saved()["nodes"]) and not saved()["alarms"]

    until(has_heard, 150, what=f"{nodes} in {state}", state=saved)


def _wait_for_records(broker: Broker, names: set[str]) -> None:
    """Wait until new records of all nodes are in Kafka."""
    bodies, waiting = kafka.read(broker.cluster, "monitor_data", group=f"wait{time.monotonic()}", wait=0.2), set(names)

    def have_arrived() -> bool:
        if body := next(bodies):
            waiting.discard(json.loads(body)["node name"])
        return not waiting

    until(have_arrived, what="records", state=lambda: waiting)


def test_command_that_nobody_takes_is_an_error(start: Start) -> None:
    command = start(*CLI, "retire", "/camera", ROS_DOMAIN_ID=str(free_dds_domain()))
    _, errors = end(command)
    assert command.returncode == 7 and "no program on ROS 2 takes the command" in errors
