"""Classes told from photos and shape against classes known, beside shape alone; on streets never trained on.

`python -m bench.segmentation [--parts streets time network kitti semkitti mesh] [--out bench-out/segmentation]`

- streets: three streets of seeds below those of training: the default European town, and two with looks drawn anew.
  point_miou is the mean over the streets of the mean over road, terrain, building, low and high vegetation.
  geometry: classes from shape alone, ground by a surface search and the rest by height above it and shape.
- time: a street of nine million points and forty photos, from tile to classes, everything included.
- network: the project's own on one photo of 1536 x 1024, by onnxruntime and by torch, turn by turn on the same cores:
  network_ratio is the first's time by the second's, network_same the share of pixels with the same class.
- mesh: distance of the truth to the meshes made by true classes and by those told (the first street).
- semkitti: shape alone on a labelled sweep (one; no photo).
- kitti: pixels against polygons drawn on ten photos of two streets, means over the classes that were drawn: kitti_miou
  with what the scan tells, kitti_photo_miou of the photos alone, kitti_carried_miou where the points' classes are
  carried back into the photos (`segmentation_kitti.py`).

Ends with `RESULT {json}`; null where a part was left out.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.measure import measure
from bench.paths import ROOT
from bench.segmentation.kitti import kitti, mean
from bench.street.run import STREETS as STREETS_OF_KITTI
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.lidar_channels import COUNT
from scan2sim.segmentation.metrics import MEAN_OF, Confusion, confusion

DATA = ROOT.parent / "shared" / "data"
STREETS = (901, 902, 903)
SEMKITTI = {
    40: "road", 44: "road", 60: "road", 48: "sidewalk", 49: "sidewalk", 72: "terrain", 50: "building",
    51: "wall_or_fence", 70: "high_vegetation", 71: "high_vegetation", 80: "pole", 81: "road_sign",
    10: "vehicle", 11: "vehicle", 13: "vehicle", 15: "vehicle", 18: "vehicle", 20: "vehicle", 252: "vehicle",
    30: "person", 254: "person",
}  # fmt: skip
PARTS = ("streets", "time", "network", "kitti", "semkitti", "mesh")
FIGURES = (
    "point_miou", "sign_iou", "geometry_miou", "minutes_9m", "network_ratio", "network_same", "kitti_miou",
    "kitti_photo_miou", "kitti_carried_miou",
)  # fmt: skip


def scan2sim(*arguments: object) -> float:
    """Run the command; seconds."""
    measured = measure([str(Path(sys.executable).parent / "scan2sim"), *map(str, arguments)])
    if measured.status:
        sys.exit(f"scan2sim {arguments[0]} failed with exit status {measured.status}")
    return measured.seconds


def street(out: Path, seed: int) -> Path:
    """A held-out street's tile, made if absent."""
    from scan2sim.data_samples.layout import Style
    from scan2sim.data_samples.street import generate
    from scan2sim.data_samples.training import any_style

    folder = out / f"street_{seed}"
    if not (folder / "tile.toml").is_file():
        style = Style() if seed == STREETS[0] else any_style(np.random.default_rng([seed, 11]))
        generate(folder, length=60, points=2e6, photos=24, seed=seed, style=style)
    return folder


def segmented(tile: Path, out: Path, *settings: str) -> tuple[Confusion, float]:
    """Run `scan2sim segment` anew on a tile whose cloud has classes; how its classes compare, and seconds."""
    from scan2sim.pipeline.io.clouds import las

    shutil.rmtree(out, ignore_errors=True)
    seconds = scan2sim("segment", tile, "--out", out, "--overwrite", *(x for s in settings for x in ("--set", s)))
    read = read_tile(tile)
    known = las.read(read.clouds[0], read.frame).classification
    found = las.read(out / "classified" / f"{read.clouds[0].stem}.laz", read.frame).classification
    assert known is not None and found is not None
    return confusion(known, found), seconds


def streets(out: Path) -> dict[str, float]:
    """Figures on the held-out streets, by photos and by shape alone."""
    rows: dict[str, list[Confusion]] = {"photos": [], "shape": []}
    for seed in STREETS:
        tile = street(out, seed)
        for kind, settings in (("photos", ()), ("shape", ("segment.photos=false",))):
            found, seconds = segmented(tile, out / f"told_{seed}_{kind}", *settings)
            rows[kind].append(found)
            sign = found.iou.get("road_sign", float("nan"))
            print(f"\nstreet {seed}, {kind}: mIoU {found.mean():.3f}, signs {sign:.3f}, {seconds:.0f} s")
            print(found.table(), flush=True)
    return {
        "point_miou": float(np.mean([c.mean() for c in rows["photos"]])),
        "sign_iou": float(np.mean([c.iou["road_sign"] for c in rows["photos"] if "road_sign" in c.iou])),
        "geometry_miou": float(np.mean([c.mean() for c in rows["shape"]])),
    }


def time_of_nine_million(out: Path) -> float:
    """Minutes from tile to classes."""
    tile = out.parent / "street_100_9e+06_40"
    if not (tile / "tile.toml").is_file():
        scan2sim("sample", "--length=100", "--points=9e6", "--photos=40", "--seed=0", tile)
    found, seconds = segmented(tile, out / "told_9m")
    print(f"\n9 million points, 40 photos: {seconds:.0f} s, mIoU {found.mean():.3f}\n{found.table()}", flush=True)
    return seconds / 60


def network() -> dict[str, float]:
    """Times and classes of the project's own network by onnxruntime and by torch."""
    from scan2sim.segmentation.backends.street import OWN

    bgr = cv2.imread(str(next((ROOT / "data_samples" / "tile" / "photos").glob("*_front.jpg"))))
    rgb = cv2.resize(bgr, (1536, 1024))[..., ::-1]
    photo = np.concatenate([rgb, np.zeros((*rgb.shape[:2], COUNT), np.uint8)], axis=2)
    networks = {form: load("street", OWN.with_suffix(form), "cpu") for form in (".onnx", ".safetensors")}
    segmented = {form: one.probabilities(photo).argmax(axis=0) for form, one in networks.items()}
    seconds: dict[str, list[float]] = {form: [] for form in networks}
    for _ in range(15):
        for form, one in networks.items():
            start = time.perf_counter()
            one.probabilities(photo)
            seconds[form].append(time.perf_counter() - start)
    onnx, torch = (float(np.median(seconds[form])) for form in networks)
    same = float((segmented[".onnx"] == segmented[".safetensors"]).mean())
    print(f"\na photo of 1536 x 1024: {onnx:.3f} s by onnxruntime, {torch:.3f} s by torch; same class: {same:.6f}")
    return {"network_ratio": onnx / torch, "network_same": same}


def mesh(out: Path) -> None:
    """Print metres from the meshes to the truth, by true classes and by those told: of their class, and of any."""
    from scan2sim.pipeline.steps.geometry import truth_error

    tile = street(out, STREETS[0])
    truth = Mesh.load(tile / "truth" / "mesh.npz")
    whole: dict[str, float] = {}
    for kind, settings in (("true", []), ("told", ["--set", "segment.overwrite=true"])):
        folder = out / f"world_{kind}"
        shutil.rmtree(folder, ignore_errors=True)
        scan2sim("run", tile, "--out", folder, "--set", "unwrap.texel=0.05", *settings)
        total = area = 0.0
        for group in ("terrain", "building", "vegetation"):
            made = Mesh.load(next((folder / "steps" / f"decimate.{group}").rglob("*.npz")))
            own, any_class = (truth_error(made, truth, group, 200_000, whatever=w) for w in (False, True))
            assert own is not None and any_class is not None
            square = float(made.face_area.sum())
            total, area = total + any_class * square, area + square
            print(f"mesh to truth, {kind} classes, {group}: {own:.4f} m of its class, {any_class:.4f} m of any")
        whole[kind] = total / area
    ratio = whole["told"] / whole["true"]
    print(f"whole world to truth: {whole['true']:.4f} m, {whole['told']:.4f} m told: {ratio - 1:+.1%}", flush=True)


def semkitti() -> Confusion:
    """Shape alone on a labelled sweep."""
    from scan2sim.segmentation.geometric import classify

    folder = DATA / "semkitti"
    xyz = np.fromfile(folder / "00_000000.bin", np.float32).reshape(-1, 4)[:, :3]
    classification = np.fromfile(folder / "00_000000.label", np.uint32) & 0xFFFF
    table = np.zeros(65536, np.uint8)
    for code, name in SEMKITTI.items():
        table[code] = CODE[name]
    found = confusion(table[classification], classify(PointCloud(Frame(), np.ascontiguousarray(xyz))))
    print(f"\nsemkitti, shape alone: mIoU {found.mean():.3f}\n{found.table()}", flush=True)
    return found


def there(name: str) -> bool:
    """Whether there is such data; says so where there is none."""
    found = (DATA / name).is_dir()
    if not found:
        print(f"left out, there is no {DATA / name}")
    return found


def main() -> None:
    """Run the parts, print tables and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "segmentation")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = dict.fromkeys(FIGURES)
    print(f"mean over {', '.join(MEAN_OF)}")
    if "streets" in arguments.parts:
        result |= streets(out)
    if "time" in arguments.parts:
        result["minutes_9m"] = time_of_nine_million(out)
    if "network" in arguments.parts:
        result |= network()
    if "mesh" in arguments.parts:
        mesh(out)
    if "semkitti" in arguments.parts and there("semkitti"):
        semkitti()
    if "kitti" in arguments.parts and all(there(street.data.name) for street in STREETS_OF_KITTI.values()):
        found = {way: mean(one) for way, one in kitti(out / "kitti").items()}
        result |= {f"kitti_{way}_miou": found[way] for way in ("photo", "carried")} | {"kitti_miou": found["scan"]}
    print("RESULT " + json.dumps({k: None if v is None else round(v, 3) for k, v in result.items()}))
