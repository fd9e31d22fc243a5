"""Street furniture and sky removal compared with the truth of synthetic streets.

`python -m bench.furniture [--seeds 0 1 2] [--length 100 --points 4e6] [--parts shape sky] [--out bench-out/furniture]`
- shape: streets are scanned, and the steps `detect_furniture` and `furniture` run on their labelled clouds.
  `pole_recall`: share of lamps and signs with a detection other than a trunk within 20 cm; `trunk_recall` of trees;
  `pole_precision`: share of detections within 30 cm of a lamp, sign or tree. `sign_plate_cm`, `pole_cm`: mean distance
  from true surface samples of sign panels, and of poles below them, to the meshes.
- sky: world of the small street with `photo_consistency.sky` off and on: `sky_share`: share of the surface of crowns
  and buildings that is far bluer and brighter than the truth; `truth_db`: PSNR of the true colours there.

Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from scan2sim.data_samples import SMALL
from scan2sim.data_samples.layout import FRAME, lay_out
from scan2sim.pipeline.camera.renderer import Renderer, textured
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F32, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.detect_furniture import DETECT_FURNITURE, DetectFurnitureParams
from scan2sim.pipeline.steps.furniture import FURNITURE, FurnitureParams

RECALL_DISTANCE_M, PRECISION_DISTANCE_M = 0.2, 0.3
"""Maximum distance of a detection from the truth for recall of poles, and for precision and trunks."""
MIN_BLUER, MIN_BRIGHTER = 30.0, 20.0
"""Excess of blue minus red and of luminance over the truth, in grey levels, at which a texel shows sky."""
COLOUR_RADIUS_M = 0.15
"""Maximum distance of the true sample that gives a texel's true colour."""


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--length", type=float, default=100.0)
    parser.add_argument("--points", type=float, default=4e6)
    parser.add_argument("--parts", nargs="+", default=["shape"], choices=("shape", "sky"))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "furniture")
    arguments = parser.parse_args()
    result: dict[str, Any] = {}
    if "shape" in arguments.parts:
        result |= shape(arguments.out, arguments.seeds, arguments.length, arguments.points)
    if "sky" in arguments.parts:
        result |= {"sky": {str(on).lower(): sky(arguments.out / f"sky_{on}", on) for on in (False, True)}}
    print("RESULT " + json.dumps(result))


def shape(out: Path, seeds: list[int], length: float, points: float) -> dict[str, float]:
    """Recall, precision and distances over all streets."""
    from scan2sim.data_samples.street import generate

    found: dict[str, list[Any]] = {"pole": [], "trunk": [], "right": [], "plate": [], "shaft": []}
    for seed in seeds:
        street = out / f"street_{length:g}_{points:g}_{seed}"
        if not (street / "tile.toml").is_file():
            generate(street, length=length, points=points, photos=0, seed=seed)
        for name, values in _street(street, seed, length).items():
            found[name] += values
        line = {name: f"{np.mean(values):.3f} of {len(values)}" for name, values in found.items() if values}
        print(f"seed {seed}: {line}", flush=True)
    return {
        "pole_recall": round(float(np.mean(found["pole"])), 3),
        "trunk_recall": round(float(np.mean(found["trunk"])), 3),
        "pole_precision": round(float(np.mean(found["right"])), 3),
        "sign_plate_cm": round(100 * float(np.mean(found["plate"])), 2),
        "pole_cm": round(100 * float(np.mean(found["shaft"])), 2),
    }


def _street(street: Path, seed: int, length: float) -> dict[str, list[Any]]:
    """Evaluate the detections of one street."""
    tile = read_tile(street / "tile.toml")
    assert tile.trajectory is not None and tile.truth_mesh is not None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        las.read(tile.clouds[0], tile.frame).save(folder / "cloud.npz")
        tile.trajectory.save(folder / "path.npz")
        cloud = {"cloud": folder / "cloud.npz"}
        found = DETECT_FURNITURE.run(cloud | {"path": folder / "path.npz"}, DetectFurnitureParams(), folder, silent)
        done = FURNITURE.run(cloud | found.files, FurnitureParams(), folder, silent)
        features = json.loads(done.files["geojson"].read_text(encoding="utf-8"))["features"]
        mesh = Mesh.load(done.files["building"])
    at = np.array([f["geometry"]["coordinates"][:2] for f in features]).reshape(-1, 2) - tile.frame.origin[:2]
    trunk = np.array([f["properties"]["kind"] == "trunk" for f in features], bool)
    layout = lay_out(length, seed)
    shift = np.subtract(FRAME.origin, tile.frame.origin)[:2]
    posts = np.array([layout.axis.place(p.s, p.t)[0] for p in layout.posts]) + shift
    trees = np.array([layout.axis.place(t.s, t.t)[0] for t in layout.trees if not t.bush]) + shift

    def nearest_distance(a: Any, b: Any) -> Any:
        return np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1, initial=np.inf)

    truth = Mesh.load(tile.truth_mesh).moved_to(mesh.frame)
    assert truth.classification is not None
    plates = sample_surface(truth.keep(truth.classification == CODE["road_sign"]), 20_000)
    shafts = sample_surface(truth.keep(truth.classification == CODE["pole"]), 20_000)
    ground = layout.height(*layout.axis.locate(shafts[:, :2] - shift))
    above = shafts[:, 2] - ground
    shafts = shafts[(above > 0.3) & (above < 2.0)]
    return {
        "pole": (nearest_distance(posts, at[~trunk]) < RECALL_DISTANCE_M).tolist(),
        "trunk": (nearest_distance(trees, at[trunk]) < PRECISION_DISTANCE_M).tolist(),
        "right": (nearest_distance(at, np.concatenate([posts, trees])) < PRECISION_DISTANCE_M).tolist(),
        "plate": distances(plates, mesh).tolist(),
        "shaft": distances(shafts, mesh).tolist(),
    }


def sky(out: Path, on: bool) -> dict[str, float]:
    """Share of sky on crowns and buildings in the small street's world, and PSNR of their colours."""
    scan2sim = str(Path(sys.executable).parent / "scan2sim")
    command = [scan2sim, "run", str(SMALL), "--out", str(out), "--set", f"photo_consistency.sky={str(on).lower()}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    folders = {g: out / "steps" / f"texture.{g}" for g in ("building", "vegetation")}
    made = {g: max(f.glob("*/textured"), key=lambda p: p.stat().st_mtime) for g, f in folders.items()}
    metrics = {f"{group}_{k}": v for group, folder in made.items() for k, v in on_surface(folder).items()}
    return metrics | {"coverage": report["texture"]["coverage"]}


def on_surface(folder: Path) -> dict[str, float]:
    """Share of the textured surface that shows sky, and PSNR of its colours, from samples on the surface."""
    from scipy.spatial import cKDTree

    body = textured(folder)
    tile = read_tile(SMALL / "tile.toml")
    assert tile.truth_points is not None
    truth = las.read(tile.truth_points, body.mesh.frame)
    assert truth.rgb is not None
    samples = sample_surface(body.mesh, 200_000)
    rgb, seen, _ = Renderer([body]).nearest(samples)
    distance, near = cKDTree(truth.xyz).query(samples, distance_upper_bound=COLOUR_RADIUS_M, workers=-1)
    held = np.isfinite(distance) & (seen == 255)
    shown, true = rgb[held].astype(np.float32), truth.rgb[near[held]].astype(np.float32)
    blue, light = _blue(shown) - _blue(true), shown.mean(axis=1) - true.mean(axis=1)
    error = float(np.mean((shown - true) ** 2))
    return {
        "sky_share": round(float(((blue > MIN_BLUER) & (light > MIN_BRIGHTER)).mean()), 5),
        "truth_db": round(10 * float(np.log10(255**2 / error)), 2),
        "painted": round(float((seen == 255).mean()), 4),
    }


def _blue(rgb: F32) -> F32:
    return np.asarray(rgb[:, 2] - rgb[:, 0], np.float32)


if __name__ == "__main__":
    main()
