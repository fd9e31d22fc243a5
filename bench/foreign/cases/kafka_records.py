"""Records of other programs on a Kafka topic: page, alarms and archive skip them, with the reason, and continue.

`python -m bench.foreign.cases.kafka_records NAME`, the command of a case, starts a broker and the three services. It
produces the record NAME and a valid record, alternately, until all three have the valid one, then prints what the
services logged.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.foreign.case import Case
from bench.waiting import until
from scan2sim.services.monitoring.export.archive import Archive
from scan2sim.services.monitoring.record import TopicFlow
from tests.fakes.broker import Broker
from tests.fakes.ports import free_dds_domain, free_port
from tests.fakes.sample_records import body

TOPIC, NODE, RULE = "monitor_data", "camera", "late"
RULES = f'[[rules]]\nname = "{RULE}"\nmetric = "latency"\nabove = 0.001\n'
WAIT_S, STOP_S, PAUSE_S = 120.0, 30.0, 0.3
Headers = Sequence[tuple[str, str | bytes | None]]
FOREIGN_ID = "a header 'record id' of another program"


@dataclass(frozen=True)
class Foreign:
    """A record as another program produces it, and what the log `says` of it.

    Attributes:
        time_ms: its time, milliseconds since the epoch; None: now.
        codec: compression.
    """

    says: str
    value: bytes | None = b"hello"
    headers: Headers = ()
    time_ms: int | None = None
    codec: str = "none"


RECORDS: dict[str, Foreign] = {
    "id-not-utf-8": Foreign(FOREIGN_ID, headers=[("record id", b"\xff\xfe")]),
    "id-without-number": Foreign(FOREIGN_ID, headers=[("record id", b"abc")]),
    "id-negative": Foreign(FOREIGN_ID, headers=[("record id", b"a:-5")]),
    "id-long": Foreign(FOREIGN_ID, headers=[("record id", b"a:" + b"9" * 5000)]),
    "id-empty": Foreign(FOREIGN_ID, headers=[("record id", b"")]),
    "id-null": Foreign("invalid JSON", headers=[("record id", None)]),
    "other-header": Foreign("invalid JSON", headers=[("content-type", b"application/json"), ("x", b"\xff")]),
    "tombstone": Foreign("a message without a body", None),
    "empty": Foreign("a message without a body", b""),
    "avro": Foreign("invalid JSON", b"\0\0\0\0\x2a\x06abc"),
    "utf-16": Foreign("invalid JSON|unknown schema", '{"node": "a"}'.encode("utf-16")),
    "byte-order-mark": Foreign("invalid JSON|unknown schema", b"\xef\xbb\xbf{}"),
    "deep": Foreign("invalid JSON", b"[" * 100_000),
    "text": Foreign("unknown schema", b'"text"'),
    "list": Foreign("unknown schema", b"[1, 2]", codec="gzip"),
    "null": Foreign("unknown schema", b"null", codec="lz4"),
    "other-object": Foreign("unknown schema", b'{"node": "<img src=x onerror=alert(1)>", "time": 1}', codec="zstd"),
    "large": Foreign("unknown schema", json.dumps({"node": "x" * 900_000}).encode(), codec="snappy"),
    "nan": Foreign("malformed", b'{"bandwidth": NaN}'),
    "huge-integer": Foreign("malformed", b'{"time": 1' + b"0" * 400 + b"}"),
    "old": Foreign("invalid JSON", time_ms=0),
    "future": Foreign("invalid JSON", time_ms=int(1000 * time.time()) + 10 * 365 * 86_400_000),
}


def cases() -> Iterator[Case]:
    """Cases of kind 1."""
    for name, record in RECORDS.items():
        yield Case(f"kafka-{name}", 1, _arguments(name), "named", record.says, module=__name__)


def _arguments(name: str) -> Callable[[Path], Sequence[object]]:
    return lambda _: (name,)


def main() -> None:
    """Run the command of a case."""
    record, folder = RECORDS[sys.argv[1]], Path.cwd()
    (folder / "rules.toml").write_text(RULES, encoding="utf-8")
    broker, port = Broker(), free_port()
    broker.start()
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(free_dds_domain()), "SCAN2SIM_TRANSPORT": "cyclone", "XDG_STATE_HOME": str(folder),
    }  # fmt: skip
    services = {
        "page": ("--port", port), "alarms": ("rules.toml", "--records-topic", TOPIC), "archive": ("archive",),
    }  # fmt: skip
    logs = {name: folder / f"{name}.log" for name in services}
    with ExitStack() as stack:
        stack.callback(broker.kill)
        stack.callback(lambda: print(*(path.read_text(encoding="utf-8") for path in logs.values()), sep="\n"))
        for name, options in services.items():
            command = ("monitor", name, *options, "--kafka", broker.servers)
            stack.enter_context(_running(command, logs[name], environment))
        steps = _alternately(broker.servers, record)

        def have_it() -> bool:
            next(steps)
            texts = {name: path.read_text(encoding="utf-8") for name, path in logs.items()}
            return _shows_the_node(port) and RULE in texts["alarms"] and "skipped" in texts["archive"]

        until(have_it, WAIT_S, what="the valid record on the page and in the alarms")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health/live", timeout=10) as answer:
            assert answer.status == 200
    assert Archive(folder / "archive").files(), "the valid record isn't in the archive"


@contextmanager
def _running(command: Sequence[object], log: Path, environment: dict[str, str]) -> Iterator[None]:
    """A service, stopped by SIGTERM at the end of the block.

    Raises:
        AssertionError: it ended by itself, or doesn't stop.
    """
    with log.open("wb") as out:
        arguments = [sys.executable, "-m", "scan2sim.flows.cli", *map(str, command)]
        process = subprocess.Popen(arguments, env=environment, stdout=out, stderr=out)
    try:
        yield
    finally:
        ended = process.poll()
        process.terminate()
        try:
            process.wait(STOP_S)
        finally:
            process.kill()
    assert ended is None, f"monitor {command[1]} ended with status {ended}"


def _alternately(servers: str, record: Foreign) -> Iterator[bool]:
    """Produce the foreign record and then a valid one at each step."""
    from confluent_kafka import Producer

    large = {"message.max.bytes": 2_000_000}
    foreign = Producer({"bootstrap.servers": servers, "compression.type": record.codec, **large})
    own = Producer({"bootstrap.servers": servers})
    flow = TopicFlow(topic="/a", direction="incoming", type="t", bandwidth=1.0, messages=1, size=1.0, latency=2_000_000)
    number = 0
    while True:
        number += 1
        about: dict[str, Any] = {} if record.time_ms is None else {"timestamp": record.time_ms}
        foreign.produce(TOPIC, record.value, headers=[*record.headers], partition=0, **about)
        own_id = f"{NODE}-0123456789abcdef:{number}"
        assert foreign.flush(30) == 0
        own.produce(TOPIC, body(NODE, time.time(), id=own_id, flows=[flow]), partition=0)
        assert own.flush(30) == 0
        time.sleep(PAUSE_S)
        yield True


def _shows_the_node(port: int) -> bool:
    now = time.time()
    try:
        window = f"http://127.0.0.1:{port}/api/history?from={now - 60}&to={now + 5}"
        with urllib.request.urlopen(window, timeout=10) as answer:
            return any(node["name"] == f"/{NODE}" for node in json.load(answer)["nodes"])
    except OSError:
        return False


if __name__ == "__main__":
    main()
