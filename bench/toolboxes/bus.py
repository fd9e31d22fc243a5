"""Two cameras and a toolbox on one machine, monitored over Kafka, and the monitoring page that shows them.

`python -m bench.toolboxes.bus [--out DIR] [--seconds 100] [--picture FILE.png]`

Two camera nodes send images of a level crossing by day and at dusk (data_samples/crossing.py) as JPEGs, 2 and 1 per
second; the toolbox `detect` finds vehicles in both. All three nodes, and alarms with the rules below, publish to a
Kafka broker, and `monitor page` displays it. After two thirds of the time the camera at dusk is stopped, which raises
an alarm on its rate. Headless Chromium saves DIR/before.png and DIR/after.png (`--picture`: a smaller copy of the
latter).

Ends with `RESULT {json}`: nodes, queues and alarms on the page before and after, and its rows of nodes and queues at
the end. Needs chromium.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
from PIL import Image

from bench.bus.page import PORT, open_page, running_command, screenshot
from scan2sim.data_samples import crossing
from tests.fakes.broker import Broker
from tests.fakes.browser import chromium

SEED, IMAGES, FIRST_IMAGE = 300, 60, 50
CAMERAS = {"day": 2.0, "dusk": 1.0}
"""Views in their order, with images per second."""
RULES = """
[[rules]]
name = "images come late"
metric = "latency"
topic = "/camera/*"
above = 0.5
hold = 5

[[rules]]
name = "camera too slow"
metric = "rate"
topic = "/camera/*"
below = 0.5
hold = 5
"""
COLOURS = 48
"""Number of colours of the small copy."""


def render(folder: Path) -> None:
    """Render a folder of images per camera."""
    for number, name in enumerate(CAMERAS):
        view = crossing.view(SEED, number, (FIRST_IMAGE + IMAGES) / crossing.FPS)
        (folder / name).mkdir(parents=True, exist_ok=True)
        for index in range(FIRST_IMAGE, FIRST_IMAGE + IMAGES):
            cv2.imwrite(str(folder / name / f"{index:03d}.png"), view.frame(index).rgb[..., ::-1])


def run_nodes(kafka: str, images: Path, out: Path, seconds: float) -> dict[str, Any]:
    """Run the nodes and take screenshots."""
    (out / "rules.toml").write_text(RULES, encoding="utf-8")
    kafka_option = ("--kafka", kafka)
    with ExitStack() as stack, tempfile.TemporaryDirectory() as browser:

        def start(*command: object) -> subprocess.Popen[bytes]:
            return stack.enter_context(running_command(out, *command))

        start("monitor", "page", *kafka_option, "--port", PORT, "--limit", "latency=0.5")
        start("monitor", "alarms", out / "rules.toml", *kafka_option)
        topics = [word for name in CAMERAS for word in ("--images", f"/camera/{name}")]
        start("toolbox", "node", "detect", *topics, "--compressed", *kafka_option)
        cameras = [
            start("toolbox", "camera", images / name, f"/camera/{name}", "--name", f"camera_{name}", "--compressed",
                  "--loop", "--rate", rate, *kafka_option)
            for name, rate in CAMERAS.items()
        ]  # fmt: skip
        page = stack.enter_context(chromium(Path(browser), "--disable-gpu"))
        open_page(page)
        page.until("document.querySelectorAll('#queues tbody tr').length", 120)
        time.sleep(2 / 3 * seconds)
        before = screenshot(page, out / "before.png")
        cameras[-1].terminate()
        time.sleep(seconds / 3)
        after = screenshot(page, out / "after.png")
        rows = "[...document.querySelectorAll('#nodes tbody tr, #queues tbody tr')].map(row => row.innerText)"
        row_texts = page.value(rows)
        assert page.errors == [], page.errors
    return {"before": before, "after": after, "rows": row_texts}


def main() -> None:
    """Run the benchmark and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "scan2sim-toolbox-bus")
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    render(given.out / "images")
    broker = Broker()
    broker.start()
    try:
        result = run_nodes(broker.servers, given.out / "images", given.out, given.seconds)
    finally:
        broker.kill()
    if given.picture:
        shown = Image.open(given.out / "after.png").convert("RGB")
        shown.quantize(COLOURS, dither=Image.Dither.NONE).save(given.picture, optimize=True)
    print(f"screenshots in {given.out}")
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
