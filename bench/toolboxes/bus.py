"""Two cameras, a toolbox and the event bus on one machine, and what the bus's page shows of them.

`python -m bench.toolboxes.bus [--out DIR] [--seconds 100] [--picture FILE.png]`

Images of a level crossing by day and of one at dusk (data_samples/crossing.py) are sent by two camera nodes, as JPEGs,
2 and 1 a second; the toolbox `detect` finds vehicles in both. All three nodes, and alarms with the rules below, tell a
broker of Kafka, and `monitor page` shows it. After two thirds of the time the camera at dusk is stopped, so that an
alarm on its rate is raised. Headless Chromium takes DIR/before.png and DIR/after.png (`--picture`: a smaller copy of
the latter).

Ends with `RESULT {json}`: nodes, queues and alarms on the page before and after, and its rows of nodes and queues at
the end. Wants chromium.
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

from bench.bus.page import PORT, opened, picture, started
from scan2sim.data_samples import crossing
from tests.browser import chromium
from tests.fakes.broker import Broker

SEED, IMAGES, FIRST = 300, 60, 50
CAMERAS = {"day": 2.0, "dusk": 1.0}
"""Views, in their order, and images a second."""
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
"""Of the small copy."""


def render(folder: Path) -> None:
    """A folder of images a camera."""
    for number, name in enumerate(CAMERAS):
        view = crossing.view(SEED, number, (FIRST + IMAGES) / crossing.FPS)
        (folder / name).mkdir(parents=True, exist_ok=True)
        for index in range(FIRST, FIRST + IMAGES):
            cv2.imwrite(str(folder / name / f"{index:03d}.png"), view.frame(index).rgb[..., ::-1])


def watch(kafka: str, images: Path, out: Path, seconds: float) -> dict[str, Any]:
    """Run it all, and take pictures."""
    (out / "rules.toml").write_text(RULES, encoding="utf-8")
    tell = ("--kafka", kafka)
    with ExitStack() as stack, tempfile.TemporaryDirectory() as browser:

        def start(*command: object) -> subprocess.Popen[bytes]:
            return stack.enter_context(started(out, *command))

        start("monitor", "page", *tell, "--port", PORT, "--limit", "latency=0.5")
        start("monitor", "alarms", out / "rules.toml", *tell)
        topics = [word for name in CAMERAS for word in ("--images", f"/camera/{name}")]
        start("toolbox", "node", "detect", *topics, "--compressed", *tell)
        cameras = [
            start("toolbox", "camera", images / name, f"/camera/{name}", "--name", f"camera_{name}", "--compressed",
                  "--loop", "--rate", rate, *tell)
            for name, rate in CAMERAS.items()
        ]  # fmt: skip
        page = stack.enter_context(chromium(Path(browser), "--disable-gpu"))
        opened(page)
        page.until("document.querySelectorAll('#queues tbody tr').length", 120)
        time.sleep(2 / 3 * seconds)
        before = picture(page, out / "before.png")
        cameras[-1].terminate()
        time.sleep(seconds / 3)
        after = picture(page, out / "after.png")
        rows = "[...document.querySelectorAll('#nodes tbody tr, #queues tbody tr')].map(row => row.innerText)"
        told = page.value(rows)
        assert page.errors == [], page.errors
    return {"before": before, "after": after, "rows": told}


def main() -> None:
    """Run it, print the result."""
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
        result = watch(broker.servers, given.out / "images", given.out, given.seconds)
    finally:
        broker.kill()
    if given.picture:
        shown = Image.open(given.out / "after.png").convert("RGB")
        shown.quantize(COLOURS, dither=Image.Dither.NONE).save(given.picture, optimize=True)
    print(f"pictures in {given.out}")
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
