"""Ablation on the real streets: their worlds without one part of the pipeline, scored by `bench.street`.

`python -m bench.street.ablation [--parts dynamic_objects instances ...] [--streets raw0009 odo04 raw0013]
[--worlds bench-out/street] [--out bench-out/street_ablation]`

A part is a line of `SETTINGS`. Each row begins with the cached results of the street's world in `--worlds` (made there
by `python -m bench.street`, or here if it is missing; hard links, so that they take no space) and computes only the
steps that its settings affect. Its metrics are stored in `rows.json` below `--out`, its renderings from the driver's
eye in `eye/PART/STREET`; rows that are stored already aren't measured again, so an interrupted ablation continues.

raw 0013 is scored by its sweeps only; the other streets by photos and sweeps. Vehicles are excluded from the metrics as
in `bench.street`; `outline_px` is the median over all outlines, `residue_m2` the maximum over parked vehicles (only
raw 0009 has their boxes). `pictures/STREET.png` below `--out` shows the worlds from the driver's eye, a column for each
part. Ends with `RESULT {json}`: by part and street.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from bench.street import lidar
from bench.street.run import STREETS, Street, build_world, score_world
from bench.street.score import truth
from bench.street.sheet import driver_views, write_sheet
from scan2sim.pipeline.core.types import U8

SETTINGS: dict[str, tuple[str, ...]] = {
    "nothing": (),
    "coarse_surface": ("photo_coverage.uncovered=remove",),
    "free_space": ("free_space.when=never",),
    "foliage_added": ("foliage.when=auto",),
    "photo_coverage": ("photo_coverage.limit=off",),
    "pose_refinement": ("pose_refinement.when=never",),
    "dynamic_objects": ("dynamic_objects.when=never",),
    "facades": ("facades.when=never",),
    "filling": ("ground.when=never", "texture.inpaint=false"),
    "outlines": ("planes.when=never", "furniture.when=never", "photo_consistency.sky=false"),
    "instances": ("instances.detect=false",),
    "signs": ("signs.when=never",),
    "exposure": ("exposure.solve=false",),
    "backdrop": ("backdrop.when=never",),
}
"""Settings that switch off a part; `foliage_added` switches on leaf cards, which are off by default."""
METRICS = (
    "psnr_db", "ssim", "nogain_psnr_db", "sharpness", "frame_psnr_db", "frame_msssim", "outline_px", "inside_mesh",
    "corridor_m2", "residue_m2", "seen_share",
)  # fmt: skip
"""By photos."""
LIDAR_METRICS = (
    "lidar_ground_cm", "lidar_early_share", "lidar_vegetation_early_share", "lidar_phantom_share", "lidar_f22",
    "lidar_chamfer_m2", "lidar_depth_median_cm", "lidar_missing_share", "returns_near_share", "returns_mid_share",
)  # fmt: skip
"""By sweeps, see `bench.street.lidar.result`."""
Row = dict[str, float | None]
Rows = dict[str, dict[str, Row]]


def prepared(street: Street, worlds: Path, folder: Path) -> None:
    """Fill an empty folder with the tile and the cached results of the street's world, as hard links."""
    world = worlds / street.name
    build_world(street, world)  # nothing is computed if it is up to date
    for part in ("tile", "run/steps"):
        shutil.copytree(world / part, folder / part, symlinks=True, copy_function=os.link)


def metrics(street: Street, folder: Path, pictures: Path, settings: tuple[str, ...]) -> Row:
    """Metrics of the street's world with these settings; by photos only where ground truth is drawn on them."""
    tile, run = build_world(street, folder, settings)
    found: dict[str, Any] = dict(lidar.result([lidar.metrics(street.data, tile, run, pictures, street.labels)]))
    if street.name in truth():
        found |= score_world(street, tile, run, pictures)
        displacements = found["displacements_px"]
        found["outline_px"] = float(np.median(displacements)) if displacements else None
        found["residue_m2"] = max(found["residue_m2"].values(), default=0.0)
    known = {name: found[name] for name in (*METRICS, *LIDAR_METRICS) if name in found}
    return {name: None if value is None else round(float(value), 3) for name, value in known.items()}


def measure(street: Street, part: str, worlds: Path, out: Path) -> Row:
    """Metrics of a row; writes its driver's views, and removes its world afterwards."""
    from PIL import Image

    folder = out / "worlds" / street.name
    shutil.rmtree(folder, ignore_errors=True)  # of a row that was interrupted
    prepared(street, worlds, folder)
    row = metrics(street, folder, out / "pictures" / part / street.name, SETTINGS[part])
    eye = out / "eye" / part / street.name
    eye.mkdir(parents=True, exist_ok=True)
    for i, (photo, rendering) in enumerate(driver_views(folder / "run")):
        Image.fromarray(photo).save(eye / f"{i}_photo.png")
        Image.fromarray(rendering).save(eye / f"{i}_world.png")
    shutil.rmtree(folder)
    return row


def eye_views(folder: Path) -> list[tuple[U8, U8]]:
    """Photos and renderings that `measure` has written."""
    from PIL import Image

    count = len(list(folder.glob("*_photo.png")))
    shown = [[np.asarray(Image.open(folder / f"{i}_{what}.png")) for what in ("photo", "world")] for i in range(count)]
    return [(photo, world) for photo, world in shown]


def table(found: Rows) -> None:
    """Print a row per part, by street: metrics by photos, then by sweeps."""
    for street in STREETS:
        for names in (METRICS, LIDAR_METRICS):
            rows = {part: streets[street] for part, streets in found.items() if names[0] in streets.get(street, {})}
            if rows:
                print(f"\n{street}, without: " + ", ".join(names))
            for part, row in rows.items():
                print(f"  {part:16}" + "".join(f"{'-' if row[k] is None else format(row[k], '.3f'):>9}" for k in names))


def main() -> None:
    """Measure the rows that are missing, and print the table and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--streets", nargs="*", choices=list(STREETS), default=list(STREETS))
    parser.add_argument("--worlds", type=Path, default=ROOT / "bench-out" / "street", help="`--out` of bench.street")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "street_ablation")
    arguments = parser.parse_args()
    out, worlds = arguments.out.resolve(), arguments.worlds.resolve()
    out.mkdir(parents=True, exist_ok=True)
    stored = out / "rows.json"
    found: Rows = json.loads(stored.read_text(encoding="utf-8")) if stored.is_file() else {}
    for name in arguments.streets:
        if not STREETS[name].data.is_dir():
            print(f"{name}: skipped, {STREETS[name].data} doesn't exist")
            continue
        for part in arguments.parts:
            if name in found.get(part, {}):
                print(f"{name} without {part}: stored in {stored}")
                continue
            found.setdefault(part, {})[name] = row = measure(STREETS[name], part, worlds, out)
            stored.write_text(json.dumps(found, indent=1), encoding="utf-8")
            print(f"{name} without {part}: {row}", flush=True)
    known = {part: found[part] for part in SETTINGS if part in found}
    for name in STREETS:
        views = {part: eye_views(out / "eye" / part / name) for part in known if name in known[part]}
        if views:
            write_sheet(list(views.values()), list(views), out / "pictures" / f"{name}.png")
    table(known)
    print("RESULT " + json.dumps(known))


if __name__ == "__main__":
    main()
