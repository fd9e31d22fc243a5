"""Cesium in headless Chromium: renders a 3D Tiles tileset as streaming clients do."""

from __future__ import annotations

import base64
import functools
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.conftest import ROOT
from tests.fakes import browser
from tests.fakes.browser import Page

NPM_PACKAGE = "cesium"
NEAR_PLANE_M = 0.1
SKY = (255, 0, 255)
"""Background colour."""
PAGE = """<!DOCTYPE html><meta charset="utf-8"><body style="margin: 0"><div id="view"></div>
<style>.cesium-widget, canvas { display: block; width: 100%; height: 100% }</style>
<script>window.CESIUM_BASE_URL = "cesium/Build/Cesium/"</script><script src="cesium/Build/Cesium/Cesium.js"></script>
<script>
const visible = new Set(), wait = (ms) => new Promise((done) => setTimeout(done, ms));
async function open(tileset, width, height) {
  Object.assign(document.getElementById("view").style, {width: width + "px", height: height + "px"});
  window.widget = new Cesium.CesiumWidget("view", {baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false,
    useDefaultRenderLoop: false, msaaSamples: 1, contextOptions: {webgl: {preserveDrawingBuffer: true}}});
  widget.scene.backgroundColor = Cesium.Color.MAGENTA;
  widget.scene.highDynamicRange = false;
  window.tiles = await Cesium.Cesium3DTileset.fromUrl("world/" + tileset, {foveatedScreenSpaceError: false});
  tiles.tileVisible.addEventListener((tile) => visible.add(tile.content.url.split("/world/")[1]));
  tiles.tileFailed.addEventListener((failure) => { throw new Error(failure.message) });
  widget.scene.primitives.add(tiles);
}
function drawn() {
  const splats = tiles.gaussianSplatPrimitive;
  if (!tiles.tilesLoaded || splats === undefined) return tiles.tilesLoaded;
  const pending = splats._pendingSnapshot ?? splats._sorterPromise;
  return pending === undefined && !splats._needsSnapshotRebuild && splats._drawCommand !== undefined;
}
async function look(position, direction, up, frustum) {
  const camera = widget.camera, vector = (v) => Cesium.Cartesian3.fromArray(v);
  Object.assign(camera.frustum, frustum);
  camera.position = vector(position);
  camera.direction = Cesium.Cartesian3.normalize(vector(direction), new Cesium.Cartesian3());
  camera.right = Cesium.Cartesian3.cross(camera.direction, vector(up), new Cesium.Cartesian3());
  Cesium.Cartesian3.normalize(camera.right, camera.right);
  camera.up = Cesium.Cartesian3.cross(camera.right, camera.direction, new Cesium.Cartesian3());
  for (let still = 0; still < 10; still = drawn() ? still + 1 : 0) {
    visible.clear();
    widget.resize();
    widget.render();
    await wait(20);
  }
  return [...visible].sort();
}
</script>"""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    if not any(map(shutil.which, browser.EXECUTABLES)):
        return "Chromium isn't installed (apt-get install chromium)"
    return "" if node_module(NPM_PACKAGE) else f"{NPM_PACKAGE} isn't installed (npm install -g {NPM_PACKAGE})"


def node_module(name: str) -> Path | None:
    """Folder of an npm package, installed globally or in the project's folder."""
    if shutil.which("npm") is None:
        return None
    global_folder = subprocess.run(["npm", "root", "-g"], capture_output=True, text=True).stdout.strip()
    found = (folder / name for folder in (Path(global_folder), ROOT / "node_modules"))
    return next((folder for folder in found if folder.is_dir()), None)


@contextmanager
def viewer(world: Path, work: Path, size: tuple[int, int], tileset: str = "tileset.json") -> Iterator[Viewer]:
    """Open a tileset in Cesium; skips the test if Cesium isn't installed.

    Args:
        world: folder with the tileset.
        work: working folder, empty or new.
        size: width and height of the canvas in pixels.
        tileset: file of the tileset.
    """
    package = node_module(NPM_PACKAGE)
    if package is None:
        pytest.skip(missing())
    work.mkdir(exist_ok=True)
    (work / "cesium").symlink_to(package)
    (work / "world").symlink_to(world.resolve())
    (work / "page.html").write_text(PAGE, encoding="utf-8")
    handler = functools.partial(_QuietHandler, directory=str(work))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, browser.chromium(work) as page:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            page.do("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/page.html")
            page.until("document.readyState === 'complete' && window.Cesium !== undefined")
            page.value(f"open({json.dumps(tileset)}, {size[0]}, {size[1]})")
            yield Viewer(page, size)
        finally:
            server.shutdown()


class Viewer:
    """Cesium showing a tileset."""

    def __init__(self, page: Page, size: tuple[int, int]) -> None:
        self.page, self._size = page, size

    def look(
        self,
        position: Sequence[float],
        direction: Sequence[float],
        up: Sequence[float],
        *,
        focal: float,
        centre: tuple[float, float] | None = None,
        pixels: float = 16.0,
    ) -> list[str]:
        """Move the camera and wait until all tiles are loaded; returns the paths of the visible contents.

        Args:
            position: camera position, earth-centred, metres.
            direction: viewing direction, earth-centred.
            up: up direction of the image, earth-centred.
            focal: focal length in pixels.
            centre: principal point in pixels, as in `Camera`; default: centre of the image.
            pixels: maximum screen space error of levels of detail; Cesium's default is 16.
        """
        width, height = self._size
        x, y = centre or (width / 2 - 0.5, height / 2 - 0.5)
        frustum = {
            "fov": float(2 * np.arctan(max(self._size) / (2 * focal))),
            "aspectRatio": width / height,
            "near": NEAR_PLANE_M,
            "xOffset": NEAR_PLANE_M * (width / 2 - x - 0.5) / focal,
            "yOffset": NEAR_PLANE_M * (y + 0.5 - height / 2) / focal,
        }
        arguments = ", ".join(map(json.dumps, (list(position), list(direction), list(up), frustum)))
        self.page.value(f"void (tiles.maximumScreenSpaceError = {pixels})")
        visible: list[str] = self.page.value(f"look({arguments})")
        assert not self.page.errors, self.page.errors
        return visible

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) RGB of the current view; background is `SKY`."""
        data = self.page.value("widget.canvas.toDataURL('image/png')").partition(",")[2]
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image[..., ::-1])


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Don't log requests."""
