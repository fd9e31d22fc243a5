"""Alarms of nodes that are alive: a broker that is down for a minute, a node whose clock is slow (part `alarms`).

20 nodes and one whose clock is 7 s slow send a record per second, through an outbox each, to a real broker. The alarm
node is a process of its own that hears them by Kafka only. The broker is killed for 60 s and restarted.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from bench.paths import ROOT
from scan2sim.services.monitoring.export.sinks import KafkaSink
from scan2sim.services.outbox import Outbox
from tests.fakes.broker import Broker
from tests.fakes.sample_records import record

NODES, CLOCK_ERROR_S = 20, -7.0
SLOW_NODE = "slow_clock"
UP_S, DOWN_S, RECOVERED_S = 20.0, 60.0, 40.0
"""Seconds with the broker, without it, and with the restarted broker."""
RULES = """
[[rules]]
name = "silent"
metric = "silence"
above = 5
"""
DOMAIN = "89"


def false_alarms() -> dict[str, int]:
    """Run the experiment.

    Returns:
        false_alarms: raised alarms of nodes, which all live; flaps: changes of alarms of the node with the slow clock;
        outage_alarms: raised alarms of the outage itself, of which there should be one.
    """
    broker = Broker()
    broker.start()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rules.toml").write_text(RULES, encoding="utf-8")
        command = [sys.executable, "-m", "scan2sim.flows.cli", "monitor", "alarms", str(Path(folder) / "rules.toml")]
        settings = {"ROS_DOMAIN_ID": DOMAIN, "SCAN2SIM_TRANSPORT": "cyclone", "XDG_STATE_HOME": folder}
        settings["PYTHONPATH"] = str(ROOT)
        node = subprocess.Popen(
            [*command, "--kafka", broker.servers], cwd=ROOT, stdout=subprocess.PIPE, text=True,
            env=os.environ | settings,
        )  # fmt: skip
        names = [*(f"node{number}" for number in range(NODES)), SLOW_NODE]
        outboxes = {name: Outbox(Path(folder) / f"{name}.outbox") for name in names}
        sinks = {name: KafkaSink(broker.cluster, "monitor_data", outbox) for name, outbox in outboxes.items()}
        ended = threading.Event()
        sender = threading.Thread(target=_send, args=(sinks, ended))
        sender.start()
        time.sleep(UP_S)
        broker.kill()
        time.sleep(DOWN_S)
        broker.start()
        time.sleep(RECOVERED_S)
        ended.set()
        sender.join()
        node.terminate()
        output, _ = node.communicate(timeout=60)
        for sink in sinks.values():
            sink.close()
    broker.kill()
    print(output, end="", flush=True)
    changes = [line for line in output.splitlines() if line.startswith(("raised", "cleared"))]
    return {
        "false_alarms": sum(line.startswith("raised silent") and SLOW_NODE not in line for line in changes),
        "flaps": sum(SLOW_NODE in line for line in changes),
        "outage_alarms": sum(line.startswith("raised Kafka is unreachable") for line in changes),
    }


def _send(sinks: dict[str, KafkaSink], ended: threading.Event) -> None:
    """Send a record per second of each node."""
    while not ended.wait(1.0):
        now = time.time()
        for name, sink in sinks.items():
            sink.send(record(name, now + (CLOCK_ERROR_S if name == SLOW_NODE else 0.0)))
