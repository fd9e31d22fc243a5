"""The monitoring page while 50 cameras are replayed: screenshots in a browser.

`python -m bench.bus.page [--out DIR] [--speed 25] [--hours 6 10] [--every 20]`

Replays the experiment of D3.2, section 3.2 (bench/bus/experiment.py) with 50 cameras whose nodes also publish to a
Kafka broker, together with `monitor alarms` with a rule on the queue's age, a `run` of the sample tile with `--bus`,
and `monitor page`. Headless Chromium takes a screenshot at a fixed interval: DIR/page-001.png and so on; one each with
the dark theme and with a phone's size (DIR/page-dark.png, DIR/page-phone.png). Needs chromium and an idle machine.

Ends with `RESULT {json}`: number of screenshots; maximum number of nodes, runs, queues and alarms shown at once; events
and lost events. The load of monitoring and of the tile's run makes events older than in the experiment itself.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

from bench.bus import experiment
from bench.bus.experiment import Outcome, Replay
from bench.paths import ROOT
from tests.fakes.broker import Broker
from tests.fakes.browser import Page, chromium

PORT = 8097
RULES = """
[[rules]]
name = "events wait too long"
metric = "queue_age"
above = {above}
hold = {hold}
"""
ALARM_AGE_S = 2.5
"""Simulated seconds that an event may wait before an alarm; the experiment's limit is twice as long."""
DESKTOP_PX, PHONE_PX = (1280, 1400), (390, 844)
"""Width and height of the page."""


def screenshot(page: Page, path: Path, size: tuple[int, int] = DESKTOP_PX, *, dark: bool = False) -> dict[str, Any]:
    """Save a screenshot of the page; returns how many entries of each kind it shows."""
    page.do(
        "Emulation.setDeviceMetricsOverride",
        width=size[0],
        height=size[1],
        deviceScaleFactor=1,
        mobile=size == PHONE_PX,
    )
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.do("Emulation.setEmulatedMedia", features=[scheme])
    time.sleep(1.5)  # until it is redrawn
    Image.fromarray(page.screenshot(whole=True)).save(path, optimize=True)
    counts = "document.querySelectorAll('{}').length"
    selectors = {"nodes": "#nodes tbody tr", "runs": ".run", "queues": "#queues tbody tr", "alarms": "#alarms tbody tr"}
    return {name: page.value(counts.format(selector)) for name, selector in selectors.items()}


@contextmanager
def running_command(folder: Path, *arguments: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A running command of scan2sim, terminated at the end of the block."""
    log = (folder / f"{'-'.join(map(str, arguments[:2])).replace('/', '-')}.err").open("wb")
    process = subprocess.Popen(
        ["nice", "-n", "10", sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)],
        env=os.environ | {"ROS_DOMAIN_ID": "60", "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        stdout=log,
        stderr=log,
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()


def record(replay: Replay, folder: Path, interval: float) -> dict[str, Any]:
    """Run a replay and take screenshots.

    Args:
        replay: replay with a Kafka broker.
        folder: folder of the screenshots.
        interval: seconds between two screenshots.
    """
    outcomes: list[Outcome] = []
    rules = folder / "rules.toml"
    rules.write_text(RULES.format(above=ALARM_AGE_S / replay.speed, hold=0.1), encoding="utf-8")
    replaying = threading.Thread(target=lambda: outcomes.extend(experiment.replay([replay], folder)))
    kafka = ("--kafka", replay.kafka)
    shown: list[dict[str, Any]] = []
    with (
        tempfile.TemporaryDirectory() as browser,
        running_command(folder, "monitor", "page", *kafka, "--port", PORT, "--limit", "latency=0.2"),
        running_command(folder, "monitor", "alarms", rules, *kafka),
        running_command(
            folder, "run", "data_samples/tile", "--out", folder / "tile", "--jobs", 1, "--bus", replay.kafka
        ),
        chromium(Path(browser), "--disable-gpu") as page,
    ):
        replaying.start()
        open_page(page)
        while replaying.is_alive():
            replaying.join(interval)
            shown.append(screenshot(page, folder / f"page-{len(shown) + 1:03d}.png"))
            if len(shown) == 3:
                screenshot(page, folder / "page-dark.png", dark=True)
                screenshot(page, folder / "page-phone.png", PHONE_PX)
        assert page.errors == [], page.errors
    maxima = {name: max(one[name] for one in shown) for name in shown[0]}
    return {"pictures": len(shown), **maxima, "events": outcomes[0].sent, "lost": outcomes[0].sent - outcomes[0].done}


def open_page(page: Page) -> None:
    """Open the monitoring page in the browser once it is served."""
    end = time.monotonic() + 60
    with socket.socket() as probe:
        while probe.connect_ex(("127.0.0.1", PORT)):
            if time.monotonic() > end:
                raise ConnectionError(f"no page at port {PORT} after 60 s")
            time.sleep(0.2)
    page.do("Page.navigate", url=f"http://127.0.0.1:{PORT}/")
    page.until("document.readyState === 'complete' && typeof held !== 'undefined' && held")


def main() -> None:
    """Run the benchmark and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speed", type=float, default=25.0)
    parser.add_argument("--hours", nargs=2, type=float, default=(6.0, 10.0))
    parser.add_argument("--every", type=float, default=20.0)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "scan2sim-bus-page")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    broker = Broker()
    broker.start()
    try:
        replay = Replay(50, given.speed, tuple(given.hours), kafka=broker.servers)
        result = record(replay, given.out, given.every)
    finally:
        broker.kill()
    print(f"screenshots in {given.out}")
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
