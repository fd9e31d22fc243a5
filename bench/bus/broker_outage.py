"""Delivery of records when the broker fails under load: none lost, no duplicates (part `broker` of `bench.bus`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.paths import ROOT
from scan2sim.services import kafka
from scan2sim.services.outbox import Deduplicator
from tests.fakes.broker import Broker

NODES, PERIOD_S = 10, 0.1
"""Number of publishing nodes, and seconds between the records of each."""
UP_S, DOWN_S, RECOVERED_S = 20.0, 60.0, 20.0
"""Seconds with the broker, without it, and with the restarted broker."""
TOPIC = "monitor_data"


def broker_down(before: float = UP_S, down: float = DOWN_S, after: float = RECOVERED_S) -> dict[str, float]:
    """Kill and restart the broker while nodes publish records and a reader reads them.

    Returns:
        broker_down_lost: records that were not read; broker_down_duplicates: records read twice, by their ids;
        records: number of records; duplicates_sent: duplicates that were dropped.
    """
    broker = Broker()
    broker.start()
    with tempfile.TemporaryDirectory() as folder:
        talkers = [_talker(Path(folder), number, broker.servers) for number in range(NODES)]
        received: list[str] = []
        duplicates: list[str] = []

        def read(seconds: float, enough: int = 0) -> None:
            """Read with a new reader; records that an earlier one has received are duplicates."""
            end = time.monotonic() + seconds
            for body in kafka.read(
                broker.cluster, TOPIC, group="bench", from_start=True, wait=0.1, dropped=duplicates.append
            ):
                if body:
                    record_id = json.loads(body)["record id"]
                    (received if deduplicator.is_new(record_id) else duplicates).append(record_id)
                if time.monotonic() > end or (enough and len(received) >= enough):
                    return

        deduplicator = Deduplicator()
        read(before)
        broker.kill()
        time.sleep(down)
        broker.start()
        read(after)
        for talker in talkers:
            talker.terminate()
        for talker in talkers:
            talker.wait(60)
        published = [json.loads(line)["record id"] for log in Path(folder).glob("*.log") for line in log.open()]
        read(60.0, len(published))
    broker.kill()
    return {
        "broker_down_lost": len(set(published) - set(received)),
        "broker_down_duplicates": len(received) - len(set(received)),
        "records": len(published),
        "duplicates_sent": len(duplicates),
    }


def _talker(folder: Path, number: int, servers: str) -> subprocess.Popen[bytes]:
    command = [
        sys.executable,
        "-m",
        "scan2sim.flows.cli",
        "monitor",
        "talker",
        f"broker_{number}",
        "--interval",
        "0.01",
    ]
    command += ["--period", str(PERIOD_S), "--kafka", servers, "--to", TOPIC]
    command += ["--log", str(folder / f"{number}.log"), "--outbox", str(folder / f"{number}.outbox")]
    environment = os.environ | {"ROS_DOMAIN_ID": "88", "SCAN2SIM_TRANSPORT": "cyclone", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=environment, cwd=ROOT, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    found = broker_down()
    print("RESULT " + json.dumps(found))
