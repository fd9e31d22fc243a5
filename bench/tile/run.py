"""The reconstruction compared with a straightforward baseline, on one generated street.

`make bench`, or `python -m bench.tile [--length 100 --points 9e6 --photos 40] [--out bench-out]`.
Both chains run alone, one after the other, in separate processes. Ours includes more in its time (visibility over all
classes, several pages at 1 cm per texel, 360-degree photos, Gazebo, Collada, GLB, the report). Ends with
`RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

from bench.measure import Measurement, measure
from bench.paths import ROOT
from bench.tile import poisson
from scan2sim.pipeline.core.classes import GROUPS
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.geometry import truth_error

SAMPLES = 200_000
# steps of ours that correspond to each step of the baseline
STEPS = {
    "read": ("ingest", "label", "segment"),
    "split": ("split",),
    "voxel": ("voxel", "path"),
    "normals": (),  # part of our voxel
    "poisson": ("poisson",),
    "trim": ("trim",),
    "islands": ("islands",),
    "decimate": ("decimate",),
    "unwrap": ("unwrap",),
    "texture": ("views", "visibility", "exposure", "photo_consistency", "view_selection", "texture"),
    "(ours only)": ("collision", "export", "geometry", "score", "pictures"),
}


def main() -> None:
    """Generate the street, run both chains, and print ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=100.0)
    parser.add_argument("--points", type=float, default=9e6)
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out")
    arguments = parser.parse_args()
    street = arguments.out / f"street_{arguments.length:g}_{arguments.points:g}_{arguments.photos}"
    scan2sim = str(Path(sys.executable).parent / "scan2sim")
    if not (street / "tile.toml").is_file():
        sizes = [f"--{k}={getattr(arguments, k):g}" for k in ("length", "points", "photos")]
        _checked(measure([scan2sim, "sample", *sizes, "--seed=0", str(street)]), "sample")
    # warm up: kernels are compiled only once per machine
    sample = ROOT / "data_samples" / "tile"
    _checked(measure([scan2sim, "run", str(sample), "--out", str(arguments.out / "warm")]), "warm-up")

    ours_out, naive_out = arguments.out / "ours", arguments.out / "naive"
    shutil.rmtree(ours_out, ignore_errors=True)
    command = [scan2sim, "run", str(street), "--out", str(ours_out)]
    ours = _checked(measure(command), "ours")
    rerun = _checked(measure(command), "rerun")
    naive = _checked(measure([sys.executable, "-m", "bench.tile.naive", str(street), str(naive_out)]), "naive")

    steps = json.loads((ours_out / "report.json").read_text(encoding="utf-8"))["steps"]
    baseline = json.loads((naive_out / "naive.json").read_text(encoding="utf-8"))
    print(f"\n{'step':<12}{'naive s':>9}{'ours s':>9}{'ratio':>8}   (ours: sum over steps, of which two run at a time)")
    for name, parts in STEPS.items():
        own = sum(s["seconds"] for node, s in steps.items() if node.split(".")[0] in parts)
        theirs = baseline.get(name, 0.0)
        print(f"{name:<12}{theirs:>9.1f}{own:>9.1f}{theirs / own if own and theirs else float('nan'):>8.1f}")
    print(f"{'whole':<12}{naive.seconds:>9.1f}{ours.seconds:>9.1f}{naive.seconds / ours.seconds:>8.1f}")
    print(
        f"{'peak GB':<12}{naive.peak_gb:>9.2f}{ours.peak_gb:>9.2f}{ours.peak_gb / naive.peak_gb:>8.2f}   (ours/naive)"
    )

    truth_file = read_tile(street).truth_mesh
    assert truth_file is not None
    truth, ratios = Mesh.load(truth_file), {}
    print(f"\n{'class':<12}{'naive cm':>9}{'ours cm':>9}{'ratio':>8}   (mesh to the true surface, mean; ours/naive)")
    for group in GROUPS:
        ours_mesh = Mesh.load(next((ours_out / "steps" / f"decimate.{group}").glob("*/mesh.npz")))
        naive_mesh = Mesh.load(naive_out / f"{group}.npz")
        mine, other = (truth_error(m, truth, group, SAMPLES) or float("nan") for m in (ours_mesh, naive_mesh))
        ratios[group] = round(mine / other, 3)
        print(f"{group:<12}{other * 100:>9.2f}{mine * 100:>9.2f}{ratios[group]:>8.2f}")
    result = {
        "time_ratio": round(naive.seconds / ours.seconds, 2),
        "memory_ratio": round(ours.peak_gb / naive.peak_gb, 2),
        "truth_ratio": ratios,
        "rerun_seconds": round(rerun.seconds, 2),
        **poisson.compare(street, ours_out),
    }
    print("RESULT " + json.dumps(result))


def _checked(measured: Measurement, what: str) -> Measurement:
    if measured.status != 0:
        sys.exit(f"{what} failed with exit status {measured.status}")
    print(f"{what}: {measured.seconds:.1f} s, peak {measured.peak_gb:.2f} GB", flush=True)
    return measured
