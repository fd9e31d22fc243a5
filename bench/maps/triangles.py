"""Triangles per point of outdoor maps: distances of points from their surface, by the limit of its triangles.

`python -m bench.maps --parts runs --maps dddmr odo04 raw0009 raw0013`, which makes the worlds, and then
`python -m bench.maps.triangles [--out bench-out/maps]`

For each class that is reconstructed: triangles, median and 95 % of the distances, and the time of decimation. Ends with
`RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from bench.paths import ROOT
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.decimation import simplify
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.steps.decimate import DECIMATE, DecimateParams

LIMITS = (3, 4, 5, 6, None)
"""Largest number of triangles per point; None: the target alone."""
CLASSES = ("building", "vegetation")


def main() -> None:
    """Print a line for each map, class and limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "maps")
    worlds = parser.parse_args().out / "worlds"
    result = {}
    for steps in sorted(worlds.glob("*/steps")):
        for name in CLASSES:
            meshes, clouds = (
                sorted(steps.glob(f"{step}.{name}/*/{file}.npz"))
                for step, file in (("islands", "mesh"), ("voxel", "cloud"))
            )
            if meshes and clouds and len(mesh := Mesh.load(meshes[-1])):
                key = f"{steps.parent.name} {name}"
                result[key] = measure(key, mesh, PointCloud.load(clouds[-1]), target(name))
    print("RESULT " + json.dumps(result))


def target(name: str) -> int:
    """Triangles that a class gets by default."""
    default: int = DECIMATE.class_defaults.get(name, {}).get("target", DecimateParams().target)
    return default


def measure(key: str, mesh: Mesh, cloud: PointCloud, target: int) -> dict[str, list[float]]:
    """Triangles, median and 95 % of the distances in centimetres, and seconds, by limit."""
    found = {}
    for limit in LIMITS:
        began = time.perf_counter()
        small = simplify(mesh, min(target, limit * len(cloud)) if limit else target)
        seconds = time.perf_counter() - began
        median, p95 = np.percentile(100 * distances(cloud.xyz, small), (50, 95)).tolist()
        found[str(limit)] = [len(small), round(median, 2), round(p95, 2), round(seconds, 1)]
        print(f"{key:24} {limit} per point: {len(small):7,} triangles, median {median:.2f}, 95 % {p95:.2f} cm, "
              f"{seconds:.1f} s", flush=True)  # fmt: skip
    return found


if __name__ == "__main__":
    main()
