"""three.js in headless Chromium, from `scan2sim view` or npm: renders GLBs as web viewers do."""

from __future__ import annotations

import base64
import functools
import json
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scan2sim.flows.reports.tile import PAGES
from scan2sim.pipeline.core.types import F64, Camera
from tests.fakes import browser
from tests.fakes.browser import Page

SKY = (255, 0, 255)
"""Background colour."""
NEAR_PLANE_M, FAR_PLANE_M = 0.05, 3000.0
PAGE = """<!DOCTYPE html><meta charset="utf-8"><body style="margin: 0">HEAD
<script>
let renderer, scene, camera;
async function open(width, height, files) {
  scene = new THREE.Scene();
  scene.background = new THREE.Color("magenta");
  camera = new THREE.PerspectiveCamera();
  camera.matrixAutoUpdate = false;
  renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.setSize(width, height);
  const statistics = { triangles: 0, textures: 0, features: 0 };
  const loader = window.decodingLoader ? decodingLoader(renderer) : new THREE.GLTFLoader();
  for (const file of files) {
    const gltf = await loader.loadAsync("world/" + file);
    scene.add(gltf.scene);
    gltf.scene.traverse((node) => {
      if (!node.isMesh) return;
      statistics.triangles += node.geometry.index.count / 3;
      statistics.textures += node.material.map?.image.width > 0;
      statistics.features += node.geometry.attributes._feature_id_0 !== undefined;
    });
  }
  return statistics;
}
function look(pose, projection) {
  camera.matrix.fromArray(pose);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  renderer.render(scene, camera);
  return renderer.domElement.toDataURL("image/png");
}
</script>"""
BUNDLED_SCRIPT = '<script src="three.js"></script>'
NPM_SCRIPT = """\
<script type="importmap">{"imports": {"three": "./npm/build/three.module.js", "three/": "./npm/"}}</script>
<script type="module">
import * as all from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { DRACOLoader } from "three/examples/jsm/loaders/DRACOLoader.js";
import { KTX2Loader } from "three/examples/jsm/loaders/KTX2Loader.js";
import { MeshoptDecoder } from "three/examples/jsm/libs/meshopt_decoder.module.js";
window.decodingLoader = (renderer) => new GLTFLoader().setMeshoptDecoder(MeshoptDecoder)
  .setDRACOLoader(new DRACOLoader().setDecoderPath("npm/examples/jsm/libs/draco/gltf/"))
  .setKTX2Loader(new KTX2Loader().setTranscoderPath("npm/examples/jsm/libs/basis/").detectSupport(renderer));
window.THREE = all;
</script>"""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if any(map(shutil.which, browser.EXECUTABLES)) else "Chromium isn't installed (apt-get install chromium)"


class Viewer:
    """three.js showing a world.

    Attributes:
        statistics: of GLBs, number of `triangles`, of meshes with a texture (`textures`) and of those with `features`.
    """

    def __init__(self, page: Page, statistics: dict[str, Any]) -> None:
        self._page, self.statistics = page, statistics

    def render(self, camera: Camera, pose: F64) -> np.ndarray:
        """(H, W, 3) RGB from a pinhole camera's pose in the world, z up; background is `SKY`."""
        camera_to_gl = np.diag([1.0, -1, -1, 1])  # x right, y up, z backwards
        y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        matrices = (y_up @ pose @ camera_to_gl).T.ravel().tolist(), _projection(camera).T.ravel().tolist()
        data = self._page.value(f"look({json.dumps(matrices[0])}, {json.dumps(matrices[1])})").partition(",")[2]
        assert not self._page.errors, self._page.errors
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image[..., ::-1])


@contextmanager
def viewer(
    world: Path,
    files: Sequence[str],
    work: Path,
    size: tuple[int, int],
    package: Path | None = None,
    source: str = PAGE,
) -> Iterator[Viewer]:
    """Open files in three.js, by default GLBs; skips the test if Chromium isn't installed.

    Args:
        world: folder of the files.
        files: names of the files.
        work: working folder, empty or new.
        size: width and height of the canvas in pixels.
        package: folder of the npm package three, which has decoders of compressed geometry and textures; default: the
            project's three.js.
        source: HTML of the page, which defines `THREE`, `open` and `look`; `HEAD` is replaced by the scripts of
            three.js.
    """
    work.mkdir(exist_ok=True)
    (work / "world").symlink_to(world.resolve())
    shutil.copyfile(PAGES / "three.js", work / "three.js")
    if package is not None:
        (work / "npm").symlink_to(package)
    (work / "page.html").write_text(source.replace("HEAD", NPM_SCRIPT if package else BUNDLED_SCRIPT), encoding="utf-8")
    handler = functools.partial(_QuietHandler, directory=str(work))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, browser.chromium(work) as page:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            page.do("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/page.html")
            page.until("document.readyState === 'complete' && window.THREE !== undefined")
            yield Viewer(page, page.value(f"open({size[0]}, {size[1]}, {json.dumps(list(files))})"))
        finally:
            server.shutdown()


def _projection(camera: Camera) -> F64:
    """(4, 4) OpenGL projection matrix of a pinhole camera; its principal point counts from the first pixel's centre."""
    width, height = camera.width, camera.height
    near, far = NEAR_PLANE_M, FAR_PLANE_M
    out = np.zeros((4, 4))
    out[0, 0], out[1, 1] = 2 * camera.fx / width, 2 * camera.fy / height
    out[0, 2], out[1, 2] = 1 - 2 * (camera.cx + 0.5) / width, 2 * (camera.cy + 0.5) / height - 1
    out[2, 2], out[2, 3], out[3, 2] = -(far + near) / (far - near), -2 * far * near / (far - near), -1
    return out


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Don't log requests."""
