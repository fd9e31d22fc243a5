"""Ablation of texturing: one part switched off at a time, on the scenes of `bench.texture`.

`python -m bench.texture.ablation [--scenes kitti street_hard] [--out bench-out/texture]`, after `python -m
bench.texture`, whose depth maps it uses. Metrics as there; ends with `RESULT {json}`: scene, part, metrics.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from bench.texture.scenes import Scene, available, fresh, run
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection.step import VIEW_SELECTION

OFF: dict[str, dict[str, dict[str, Any]]] = {
    "all parts on": {},
    "exposure": {"exposure": {"solve": False}},
    "ghost masks": {"photo_consistency": {"ghosts": False}},
    "displacement": {"photo_consistency": {"align": False}},
    "smooth choice": {"view_selection": {"smoothness": 0}},
    "blended low frequencies": {"texture": {"band": 0}},
    "one photo's detail": {"texture": {"band": -1}},
    "fading along seams": {"texture": {"fade": False}},
    "charts cut from photos": {"unwrap": {"backend": "xatlas"}},
}
"""Parameters by step that switch off each part."""


def paint(scene: Scene, given: dict[str, dict[str, Any]], folder: Path) -> Path:
    """Texture a scene with some parameters; returns the texture's folder."""
    files = {"mesh": scene.mesh, "views": scene.views, "depth": scene.depth} | scene.clouds
    for step in (EXPOSURE, PHOTO_CONSISTENCY, VIEW_SELECTION, UNWRAP, TEXTURE):
        files |= run(step, files, fresh(folder / step.name), **given.get(step.name, {}))
    return files["textured"]


def metrics(scene: Scene, folder: Path, clean: Path | None) -> dict[str, float]:
    """Metrics of a texture at the held-out photos, on streets also against the truth; ghosts if `clean` is given."""
    from scan2sim.pipeline.camera.renderer import Renderer, textured
    from scan2sim.texturing.evaluate import held_out

    held = scene.photos(held_out=True)
    results = list(
        held_out(Renderer([textured(folder)]), list(held.values()), [scene.depth / f"{i}.npy" for i in held])
    )
    out = {
        key: round(float(np.mean([getattr(result, key) for result in results])), 3)
        for key in ("psnr_db", "psnr_gain_db", "ssim", "sharpness")
    }
    if scene.folder.name.startswith("street"):
        from bench.texture.truth import samples, truth_psnr

        out["truth_gain_db"] = round(truth_psnr(folder, samples(scene))[1], 3)
    if clean is not None:
        from bench.texture.truth import Road

        clean_scene = Scene(scene.folder.with_name("street_clean"))
        out["ghosts"] = Road(clean_scene, scene).ghosts(clean, folder)[0]
    return out


def main() -> None:
    """Print a table per scene, and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["kitti", "street_hard"])
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "texture")
    arguments = parser.parse_args()
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name in arguments.scenes:
        if not available(name):
            continue
        scene, result[name] = Scene(arguments.out / name), {}
        for part, given in OFF.items():
            folder = paint(scene, given, scene.folder / "ablation")
            clean = scene.folder.with_name("street_clean") / "methods" / "ours" if name == "street_hard" else None
            result[name][part] = metrics(scene, folder, clean)
            print(f"{name:12s} {part:26s} {result[name][part]}", flush=True)
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
