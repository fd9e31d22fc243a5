"""What becomes of records when the broker dies under load (part `broker` of `bench.bus`): none lost, none double."""

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
from scan2sim.services.outbox import Once
from tests.fakes.broker import Broker

NODES, PERIOD = 10, 0.1
"""Nodes that tell, and seconds between the records of each."""
BEFORE, DOWN, AFTER = 20.0, 60.0, 20.0
"""Seconds that they tell: with the broker, without, and with it again."""
TOPIC = "monitor_data"


def broker_down(before: float = BEFORE, down: float = DOWN, after: float = AFTER) -> dict[str, float]:
    """Nodes tell, the broker is killed and started again; a reader reads all along.

    Returns:
        broker_down_lost: records that no reader got; broker_down_doubles: that it got twice, by their ids; records,
        how many there were; doubles_sent, those that came twice and were dropped.
    """
    broker = Broker()
    broker.start()
    with tempfile.TemporaryDirectory() as folder:
        talkers = [_talker(Path(folder), number, broker.servers) for number in range(NODES)]
        taken: list[str] = []
        doubles: list[str] = []

        def read(seconds: float, enough: int = 0) -> None:
            """By a reader of its own: what an earlier one took is a double for it, too."""
            end = time.monotonic() + seconds
            for body in kafka.read(
                broker.servers, TOPIC, group="bench", from_start=True, wait=0.1, dropped=doubles.append
            ):
                if body:
                    told = json.loads(body)["record id"]
                    (taken if once.new(told) else doubles).append(told)
                if time.monotonic() > end or (enough and len(taken) >= enough):
                    return

        once = Once()
        read(before)
        broker.kill()
        time.sleep(down)
        broker.start()
        read(after)
        for talker in talkers:
            talker.terminate()
        for talker in talkers:
            talker.wait(60)
        told = [json.loads(line)["record id"] for log in Path(folder).glob("*.log") for line in log.open()]
        read(60.0, len(told))
    broker.kill()
    return {
        "broker_down_lost": len(set(told) - set(taken)),
        "broker_down_doubles": len(taken) - len(set(taken)),
        "records": len(told),
        "doubles_sent": len(doubles),
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
    command += ["--period", str(PERIOD), "--kafka", servers, "--to", TOPIC]
    command += ["--log", str(folder / f"{number}.log"), "--spool", str(folder / f"{number}.spool")]
    environment = os.environ | {"ROS_DOMAIN_ID": "88", "SCAN2SIM_TRANSPORT": "cyclone", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=environment, cwd=ROOT, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    found = broker_down()
    print("RESULT " + json.dumps(found))
