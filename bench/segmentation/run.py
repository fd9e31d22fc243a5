"""Predicted classes compared with ground truth, with and without photos, on streets not used for training.

`python -m bench.segmentation [--parts streets time network kitti semkitti mesh] [--out bench-out/segmentation]`

- streets: three streets with seeds below those of training: the default European town, and two with random styles.
  point_miou is the mean over the streets of the mean over road, terrain, building, low and high vegetation.
  geometry: classes from geometry alone (ground extraction, then height above ground and shape).
- time: a street of nine million points and forty photos, from tile to classes, everything included.
- network: the project's network on one photo of 1536 x 1024 with onnxruntime and with torch, alternately on the same
  cores: network_ratio is the ratio of their times, network_same the share of pixels with the same class.
- mesh: distance from the true surface to meshes made with true and with predicted classes (the first street).
- semkitti: geometry alone on one labelled sweep (no photos).
- kitti: pixels compared with polygons drawn on ten photos of two streets, means over the labelled classes: kitti_miou
  with the scan's channels, kitti_photo_miou from the photos alone, kitti_carried_miou with the points' classes
  projected into the photos (`bench/segmentation/kitti.py`).

Ends with `RESULT {json}`; null for parts that were not run.
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
from scan2sim.segmentation.lidar_channels import CHANNELS
from scan2sim.segmentation.metrics import MEAN_OF, Confusion, confusion

DATA = ROOT.parent / "shared" / "data"
STREETS = (901, 902, 903)
SEMKITTI_CLASSES = {
    40: "road", 44: "road", 60: "road", 48: "sidewalk", 49: "sidewalk", 72: "terrain", 50: "building",
    51: "wall_or_fence", 70: "high_vegetation", 71: "high_vegetation", 80: "pole", 81: "road_sign",
    10: "vehicle", 11: "vehicle", 13: "vehicle", 15: "vehicle", 18: "vehicle", 20: "vehicle", 252: "vehicle",
    30: "person", 254: "person",
}  # fmt: skip
PARTS = ("streets", "time", "network", "kitti", "semkitti", "mesh")
RESULT_KEYS = (
    "point_miou", "sign_iou", "geometry_miou", "minutes_9m", "network_ratio", "network_same", "kitti_miou",
    "kitti_photo_miou", "kitti_carried_miou",
)  # fmt: skip


def scan2sim(*arguments: object) -> float:
    """Run the command; returns seconds."""
    measured = measure([str(Path(sys.executable).parent / "scan2sim"), *map(str, arguments)])
    if measured.status:
        sys.exit(f"scan2sim {arguments[0]} failed with exit status {measured.status}")
    return measured.seconds


def street(out: Path, seed: int) -> Path:
    """Tile of a held-out street, generated if missing."""
    from scan2sim.data_samples.layout import Style
    from scan2sim.data_samples.street import generate
    from scan2sim.data_samples.training import random_style

    folder = out / f"street_{seed}"
    if not (folder / "tile.toml").is_file():
        style = Style() if seed == STREETS[0] else random_style(np.random.default_rng([seed, 11]))
        generate(folder, length=60, points=2e6, photos=24, seed=seed, style=style)
    return folder


def segment_tile(tile: Path, out: Path, *settings: str) -> tuple[Confusion, float]:
    """Run `scan2sim segment` on a labelled tile; returns the confusion of its classes, and seconds."""
    from scan2sim.pipeline.io.clouds import las

    shutil.rmtree(out, ignore_errors=True)
    seconds = scan2sim("segment", tile, "--out", out, "--overwrite", *(x for s in settings for x in ("--set", s)))
    read = read_tile(tile)
    known = las.read(read.clouds[0], read.frame).classification
    found = las.read(out / "classified" / f"{read.clouds[0].stem}.laz", read.frame).classification
    assert known is not None and found is not None
    return confusion(known, found), seconds


def streets(out: Path) -> dict[str, float]:
    """Results on the held-out streets, with photos and with geometry alone."""
    rows: dict[str, list[Confusion]] = {"photos": [], "shape": []}
    for seed in STREETS:
        tile = street(out, seed)
        for kind, settings in (("photos", ()), ("shape", ("segment.photos=false",))):
            found, seconds = segment_tile(tile, out / f"classified_{seed}_{kind}", *settings)
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
    """Minutes from tile to classes for nine million points."""
    tile = out.parent / "street_100_9e+06_40"
    if not (tile / "tile.toml").is_file():
        scan2sim("sample", "--length=100", "--points=9e6", "--photos=40", "--seed=0", tile)
    found, seconds = segment_tile(tile, out / "classified_9m")
    print(f"\n9 million points, 40 photos: {seconds:.0f} s, mIoU {found.mean():.3f}\n{found.table()}", flush=True)
    return seconds / 60


def network() -> dict[str, float]:
    """Times and classes of the project's network with onnxruntime and with torch."""
    from scan2sim.segmentation.backends.street import DEFAULT_WEIGHTS

    bgr = cv2.imread(str(next((ROOT / "data_samples" / "tile" / "photos").glob("*_front.jpg"))))
    rgb = cv2.resize(bgr, (1536, 1024))[..., ::-1]
    photo = np.concatenate([rgb, np.zeros((*rgb.shape[:2], CHANNELS), np.uint8)], axis=2)
    networks = {form: load("street", DEFAULT_WEIGHTS.with_suffix(form), "cpu") for form in (".onnx", ".safetensors")}
    segment_tile = {form: one.probabilities(photo).argmax(axis=0) for form, one in networks.items()}
    seconds: dict[str, list[float]] = {form: [] for form in networks}
    for _ in range(15):
        for form, one in networks.items():
            start = time.perf_counter()
            one.probabilities(photo)
            seconds[form].append(time.perf_counter() - start)
    onnx, torch = (float(np.median(seconds[form])) for form in networks)
    same = float((segment_tile[".onnx"] == segment_tile[".safetensors"]).mean())
    print(f"\na photo of 1536 x 1024: onnxruntime {onnx:.3f} s, torch {torch:.3f} s; same class: {same:.6f}")
    return {"network_ratio": onnx / torch, "network_same": same}


def mesh(out: Path) -> None:
    """Print distances (m) from meshes to the truth, for true and predicted classes: to their class, and to any."""
    from scan2sim.pipeline.steps.geometry import truth_error

    tile = street(out, STREETS[0])
    truth = Mesh.load(tile / "truth" / "mesh.npz")
    whole: dict[str, float] = {}
    for kind, settings in (("true", []), ("predicted", ["--set", "segment.overwrite=true"])):
        folder = out / f"world_{kind}"
        shutil.rmtree(folder, ignore_errors=True)
        scan2sim("run", tile, "--out", folder, "--set", "unwrap.texel=0.05", *settings)
        total = area = 0.0
        for group in ("terrain", "building", "vegetation"):
            made = Mesh.load(next((folder / "steps" / f"decimate.{group}").rglob("*.npz")))
            own, any_class = (truth_error(made, truth, group, 200_000, any_class=w) for w in (False, True))
            assert own is not None and any_class is not None
            square = float(made.face_area.sum())
            total, area = total + any_class * square, area + square
            print(f"mesh to truth, {kind} classes, {group}: {own:.4f} m to its class, {any_class:.4f} m to any")
        whole[kind] = total / area
    ratio = whole["predicted"] / whole["true"]
    print(
        f"whole world to truth: {whole['true']:.4f} m, predicted {whole['predicted']:.4f} m: {ratio - 1:+.1%}",
        flush=True,
    )


def semkitti() -> Confusion:
    """Geometry alone on a labelled sweep."""
    from scan2sim.segmentation.geometric import classify

    folder = DATA / "semkitti"
    xyz = np.fromfile(folder / "00_000000.bin", np.float32).reshape(-1, 4)[:, :3]
    classification = np.fromfile(folder / "00_000000.label", np.uint32) & 0xFFFF
    table = np.zeros(65536, np.uint8)
    for code, name in SEMKITTI_CLASSES.items():
        table[code] = CODE[name]
    found = confusion(table[classification], classify(PointCloud(Frame(), np.ascontiguousarray(xyz))))
    print(f"\nsemkitti, geometry alone: mIoU {found.mean():.3f}\n{found.table()}", flush=True)
    return found


def available(name: str) -> bool:
    """Whether a data set exists; prints a message if not."""
    found = (DATA / name).is_dir()
    if not found:
        print(f"skipped, {DATA / name} doesn't exist")
    return found


def main() -> None:
    """Run the parts, and print tables and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "segmentation")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = dict.fromkeys(RESULT_KEYS)
    print(f"mean over {', '.join(MEAN_OF)}")
    if "streets" in arguments.parts:
        result |= streets(out)
    if "time" in arguments.parts:
        result["minutes_9m"] = time_of_nine_million(out)
    if "network" in arguments.parts:
        result |= network()
    if "mesh" in arguments.parts:
        mesh(out)
    if "semkitti" in arguments.parts and available("semkitti"):
        semkitti()
    if "kitti" in arguments.parts and all(available(street.data.name) for street in STREETS_OF_KITTI.values()):
        found = {method: mean(one) for method, one in kitti(out / "kitti").items()}
        result |= {f"kitti_{one}_miou": found[one] for one in ("photo", "carried")} | {"kitti_miou": found["scan"]}
    print("RESULT " + json.dumps({k: None if v is None else round(v, 3) for k, v in result.items()}))
