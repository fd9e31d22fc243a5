"""Screenshots of the driver page: a drive with three cameras by day, at night, and when the station has stopped.

    python -m bench.teleop.pictures DIR [TILE]

The cameras show the photos of a tile (default: data_samples/tile) whose names end in _front, _left and _right. Writes
cockpit-day.png, cockpit-night.png and cockpit-stale.png, and ends with `RESULT {json}`: what each shows.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from PIL import Image

from bench.paths import ROOT
from bench.teleop.cockpit import LIVE, WAIT_S, Desk
from tests.fakes.driver_controls import hold

CAMERAS = ("front", "left", "right")
FRAME_PX, SCREEN_PX = (800, 600), (1600, 900)
"""Size of the cameras' frames; of the driver's screen."""
FACTS = """({
  status: byId("status").textContent,
  speed: byId("speed").textContent,
  cameras: cameras.size,
  night: document.body.hasAttribute("data-night"),
})"""


def take(folder: Path, tile: Path) -> dict[str, Any]:
    """Take the screenshots; returns what the page showed in each."""
    shown = {}
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name, ExitStack() as stack:
        work = Path(name)
        desk = Desk(work, stack, [f"{one}=replay:{_photos(tile, one, work)}" for one in CAMERAS], FRAME_PX)
        desk.page.do(
            "Emulation.setDeviceMetricsOverride", width=SCREEN_PX[0], height=SCREEN_PX[1], deviceScaleFactor=1,
            mobile=False,
        )  # fmt: skip

        def save(what: str) -> None:
            Image.fromarray(desk.page.screenshot()).save(folder / f"cockpit-{what}.png", optimize=True)
            shown[what] = desk.page.value(FACTS)

        desk.drive()
        desk.page.value("geometry('shown').click(), 0")
        desk.page.click("#full")
        desk.page.until("document.fullscreenElement !== null", WAIT_S)
        hold(desk.page, "up", True)
        desk.page.do("Input.dispatchKeyEvent", type="rawKeyDown", code="ArrowLeft", key="ArrowLeft")
        desk.page.until("Number(byId('speed').textContent) > 3", WAIT_S)
        save("day")
        desk.page.value("toggleNight(), 0")
        time.sleep(0.5)
        save("night")
        desk.page.value("toggleNight(), 0")
        os.kill(desk.station.pid, signal.SIGSTOP)
        desk.page.until(f"!({LIVE})", WAIT_S)
        time.sleep(0.5)
        save("stale")
        os.kill(desk.station.pid, signal.SIGCONT)
    return shown


def _photos(tile: Path, camera: str, work: Path) -> Path:
    """Folder with the first photo of a camera."""
    found = sorted((tile / "photos").glob(f"*_{camera}.jpg"))
    if not found:
        raise FileNotFoundError(f"{tile} has no photos *_{camera}.jpg")
    folder = work / camera
    folder.mkdir()
    shutil.copy(found[0], folder)
    return folder


def main() -> None:
    """Run the command."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    tile = Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "data_samples" / "tile"
    print("RESULT", json.dumps(take(folder, tile)))


if __name__ == "__main__":
    main()
