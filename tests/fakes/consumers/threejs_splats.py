"""three.js' own splats (`GaussianSplat`) in headless Chromium: PLY, SPZ and GLB from a photo's pose.

three.js renders the same splats differently from `SplatRenderer` and from the reference implementation:

- It cuts splats at two standard deviations, not at an alpha of 1/255.
- It reduces the opacity of splats that its low-pass filter widens.
- It sorts by depth in 4096 bins over the depths of all splats: 12 cm each, because of the sky's shell.

On the demo tile, the PSNR between its image and ours is therefore 32 dB. The files aren't the cause: a rasterizer with
these three rules, written once to find it, agrees with three.js at 53 dB. With the first rule alone, the PSNR to ours
is 36 dB, with the second alone 39 dB. The images of the three files are compared more strictly with each other.

`GaussianSplat` needs `WebGPURenderer`, here with its WebGL 2 backend: WebGPU on SwiftShader fails in headless Chromium.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scan2sim.pipeline.core.types import U8
from tests.fakes import threejs
from tests.fakes.cesium import node_module
from tests.fakes.world_checks import Fault, renderings
from tests.fakes.world_checks.reference import Photo, WorldReference

FORMAT = "splats"
NPM_PACKAGE, NPM_VERSION = "three", "0.187"
SPLAT_SCRIPT = "examples/jsm/objects/GaussianSplat.js"
"""File of the package, from version 0.187."""
MIN_PSNR_DB = 30.0
"""Least PSNR between three.js' image of the PLY and ours; see above why it isn't higher."""
MIN_PSNR_FILES_DB = 35.0
"""Least PSNR between its images of the other files and of the PLY; on the demo tile, SPZ has 42 dB, the GLB 81 dB."""
GREY = 0.5
"""Background colour of both images, sRGB; visible where neither splats nor the sky's shell are."""
PAGE = """<!DOCTYPE html><meta charset="utf-8"><body style="margin: 0">
<script type="importmap">{"imports": {"three": "./npm/build/three.webgpu.js", "three/": "./npm/",
  "three/webgpu": "./npm/build/three.webgpu.js", "three/tsl": "./npm/build/three.tsl.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "three/examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GaussianSplatPLYLoader } from "three/examples/jsm/loaders/GaussianSplatPLYLoader.js";
import { SPZLoader } from "three/examples/jsm/loaders/SPZLoader.js";
import { GaussianSplat } from "three/examples/jsm/objects/GaussianSplat.js";
THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;  // in which splats are blended
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
const renderer = new THREE.WebGPURenderer({ forceWebGL: true });
const loaders = {
  async ply(url) {
    const splats = new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync(url));
    splats.rotation.x = -Math.PI / 2;  // z is up in PLY
    return splats;
  },
  async spz(url) { return new GaussianSplat(await new SPZLoader().loadAsync(url)); },
  async glb(url) {
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    return (await loader.loadAsync(url)).scene;
  },
};
async function open(width, height, files) {
  scene.background = new THREE.Color(0.5, 0.5, 0.5);
  camera.matrixAutoUpdate = false;
  renderer.setSize(width, height);
  await renderer.init();
  for (const file of files) scene.add(await loaders[file.split(".").pop()]("world/" + file));
  let splats = 0;
  scene.traverse((node) => { splats += node.isGaussianSplat ? node.splatGeometry.attributes.position.count : 0 });
  return { splats };
}
function look(pose, projection) {
  camera.matrix.fromArray(pose);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  renderer.render(scene, camera);
  return renderer.domElement.toDataURL("image/png");
}
Object.assign(window, { THREE, open, look });
</script>"""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return threejs.missing() or (
        "" if _package() else f"three.js isn't installed (npm install -g {NPM_PACKAGE}@{NPM_VERSION})"
    )


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load the files of each format and render them from a photo's pose, see the module's docstring.

    `ours_psnr_db`: between three.js' image of the PLY and ours; `spz_psnr_db`, `glb_psnr_db`: between its images of
    these files and of the PLY.

    Raises:
        Fault: splats are missing, or an image differs.
    """
    from scan2sim.pipeline.core.splats import SplatLayer, Splats
    from scan2sim.pipeline.io import splat_files
    from scan2sim.texturing.splats.view import SplatRenderer

    plain = sorted(export.glob("*.ply"))
    whole = Splats(np.concatenate([splat_files.read(path).parameters for path in plain]))
    photo = renderings.photo(reference)
    background = np.full((2, 4, 3), GREY, np.float32)
    ours = SplatRenderer(SplatLayer(whole, background)).view(photo.camera, photo.pose).rgb
    images = {end: _image(export, end, photo, len(whole)) for end in ("ply", "spz", "glb")}
    metrics = {"splats": len(whole), "ours_psnr_db": round(cv2.PSNR(images["ply"], ours), 2)}
    metrics |= {f"{end}_psnr_db": round(cv2.PSNR(images[end], images["ply"]), 2) for end in ("spz", "glb")}
    if metrics["ours_psnr_db"] < MIN_PSNR_DB:
        raise Fault("its image of the PLY differs from ours", metrics)
    for end in ("spz", "glb"):
        if metrics[f"{end}_psnr_db"] < MIN_PSNR_FILES_DB:
            raise Fault(f"its image of {end.upper()} differs from that of the PLY", metrics)
    everywhere = np.ones(ours.shape[:2], bool)
    return metrics | renderings.compare(export, "threejs_splats", photo, images["ply"], everywhere)


def _image(export: Path, suffix: str, photo: Photo, count: int) -> U8:
    """(H, W, 3) three.js' image of all files with a suffix.

    Raises:
        Fault: they don't have `count` splats.
    """
    files = sorted(path.name for path in export.glob(f"*.{suffix}"))
    size = photo.camera.width, photo.camera.height
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work,
        threejs.viewer(export, files, Path(work), size, _package(), PAGE) as view,
    ):
        if view.statistics["splats"] != count:
            raise Fault(f"{view.statistics['splats']} of {count} splats are loaded from {suffix.upper()}")
        return view.render(photo.camera, photo.pose)


def _package() -> Path | None:
    """Folder of the npm package, if it has splats."""
    package = node_module(NPM_PACKAGE)
    return package if package and (package / SPLAT_SCRIPT).is_file() else None
