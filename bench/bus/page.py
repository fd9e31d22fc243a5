"""The live page while 50 cameras are replayed: pictures of it in a browser.

`python -m bench.bus.page [--out DIR] [--speed 25] [--hours 6 10] [--every 20]`

The experiment of D3.2's section 3.2 (bench/bus/experiment.py) with 50 cameras, whose nodes tell a broker of Kafka, too;
beside it `monitor alarms` with a rule on the queue's age, a `run` of the sample tile with `--bus`, and `monitor page`.
Headless Chromium looks at the page every so many seconds: DIR/page-001.png and so on, in the middle also dark and as a
telephone shows it (DIR/page-dark.png, DIR/page-phone.png). Wants chromium, and some minutes of a quiet machine.

Ends with `RESULT {json}`: pictures, nodes, runs, queues and alarms that were to be seen at once, at most; events, and
how many were lost. What watching and the run of the tile cost makes events older than in the experiment itself.
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
from tests.browser import Page, chromium
from tests.fakes.broker import Broker

PORT = 8097
RULES = """
[[rules]]
name = "events wait too long"
metric = "queue_age"
above = {above}
hold = {hold}
"""
ALARMING = 2.5
"""Seconds of the mission's time that an event may wait; the experiment's limit is twice as long."""
WIDE, PHONE = (1280, 1400), (390, 844)
"""Pixels."""


def picture(page: Page, path: Path, size: tuple[int, int] = WIDE, *, dark: bool = False) -> dict[str, Any]:
    """Save what the page shows; returns how much there is to see."""
    page.do(
        "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=size == PHONE
    )
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.do("Emulation.setEmulatedMedia", features=[scheme])
    time.sleep(1.5)  # drawn anew
    Image.fromarray(page.picture(whole=True)).save(path, optimize=True)
    counts = "document.querySelectorAll('{}').length"
    seen = {"nodes": "#nodes tbody tr", "runs": ".run", "queues": "#queues tbody tr", "alarms": "#alarms tbody tr"}
    return {name: page.value(counts.format(place)) for name, place in seen.items()}


@contextmanager
def started(folder: Path, *arguments: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A command of scan2sim's, which ends with the block."""
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


def watch(replay: Replay, folder: Path, every: float) -> dict[str, Any]:
    """Replay, and take pictures meanwhile.

    Args:
        replay: with Kafka.
        folder: of the pictures.
        every: seconds between two.
    """
    outcomes: list[Outcome] = []
    rules = folder / "rules.toml"
    rules.write_text(RULES.format(above=ALARMING / replay.speed, hold=0.1), encoding="utf-8")
    running = threading.Thread(target=lambda: outcomes.extend(experiment.replay([replay], folder)))
    kafka = ("--kafka", replay.kafka)
    seen: list[dict[str, Any]] = []
    with (
        tempfile.TemporaryDirectory() as browser,
        started(folder, "monitor", "page", *kafka, "--port", PORT, "--limit", "latency=0.2"),
        started(folder, "monitor", "alarms", rules, *kafka),
        started(folder, "run", "data_samples/tile", "--out", folder / "tile", "--jobs", 1, "--bus", replay.kafka),
        chromium(Path(browser), "--disable-gpu") as page,
    ):
        running.start()
        opened(page)
        while running.is_alive():
            running.join(every)
            seen.append(picture(page, folder / f"page-{len(seen) + 1:03d}.png"))
            if len(seen) == 3:
                picture(page, folder / "page-dark.png", dark=True)
                picture(page, folder / "page-phone.png", PHONE)
        assert page.errors == [], page.errors
    most = {name: max(one[name] for one in seen) for name in seen[0]}
    return {"pictures": len(seen), **most, "events": outcomes[0].sent, "lost": outcomes[0].sent - outcomes[0].done}


def opened(page: Page) -> None:
    """Have a browser show it, once it answers."""
    end = time.monotonic() + 60
    with socket.socket() as probe:
        while probe.connect_ex(("127.0.0.1", PORT)):
            if time.monotonic() > end:
                raise ConnectionError(f"the page doesn't answer at port {PORT}")
            time.sleep(0.2)
    page.do("Page.navigate", url=f"http://127.0.0.1:{PORT}/")
    page.until("document.readyState === 'complete' && typeof held !== 'undefined' && held")


def main() -> None:
    """Run it, print the result."""
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
        result = watch(replay, given.out, given.every)
    finally:
        broker.kill()
    print(f"pictures in {given.out}")
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
