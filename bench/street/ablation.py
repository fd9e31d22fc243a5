"""Ablation on two real streets: their worlds without one part of the pipeline, score_world by `bench.street`.

`python -m bench.street.ablation [--parts dynamic_objects instances ...] [--streets odo04 raw0009]
[--out bench-out/street_ablation]`

Vehicles are excluded from the metrics as in `bench.street`; `outline_px` is the median over all outlines, `remains_m2`
the maximum over parked vehicles (only raw 0009 has their boxes). Ends with `RESULT {json}`: by part and street.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from bench.street.run import STREETS, Street, build_world, score_world

WITHOUT: dict[str, tuple[str, ...]] = {
    "nothing": (),
    "dynamic_objects": ("dynamic_objects.when=never",),
    "instances": ("instances.find=false",),
    "photo_coverage": ("photo_coverage.limit=off",),
    "outlines": ("planes.when=never", "furniture.when=never", "photo_consistency.sky=false"),
    "facades": ("facades.when=never",),
    "signs": ("signs.when=never",),
    "filling": ("ground.when=never", "texture.inpaint=false"),
    "pose_refinement": ("pose_refinement.when=never",),
}
"""Settings that switch off a part."""
METRICS = ("psnr_db", "ssim", "sharpness", "outline_px", "inside_mesh", "corridor_m2", "remains_m2", "seen_share")


def metrics(street: Street, folder: Path, pictures: Path, settings: tuple[str, ...]) -> dict[str, float]:
    """Metrics of the street's world with these settings."""
    found: dict[str, Any] = score_world(street, *build_world(street, folder, settings), pictures)
    found["outline_px"] = float(np.median(found["displacements_px"]))
    found["remains_m2"] = max(found["remains_m2"].values(), default=0.0)
    return {name: round(float(found[name]), 3) for name in METRICS}


def table(found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Print a row per disabled part, by street."""
    for name in STREETS:
        print(f"\n{name}, without: " + ", ".join(METRICS))
        for part, streets in found.items():
            if name in streets:
                print(f"  {part:10}" + "".join(f"{streets[name][key]:>9.2f}" for key in METRICS))


def main() -> None:
    """Run the streets without each part, and print the table and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=list(WITHOUT), default=list(WITHOUT))
    parser.add_argument("--streets", nargs="*", choices=list(STREETS), default=list(STREETS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "street_ablation")
    arguments = parser.parse_args()
    out: Path = arguments.out.resolve()
    found: dict[str, dict[str, dict[str, float]]] = {}
    for part in arguments.parts:
        for name in arguments.streets:
            if not STREETS[name].data.is_dir():
                print(f"{name}: skipped, {STREETS[name].data} doesn't exist")
                continue
            shutil.rmtree(out / name / "run" / "world", ignore_errors=True)
            without = metrics(STREETS[name], out / name, out / "pictures" / part, WITHOUT[part])
            found.setdefault(part, {})[name] = without
            print(f"{name} without {part}: {without}", flush=True)
    table(found)
    print("RESULT " + json.dumps(found))


if __name__ == "__main__":
    main()
