"""Completion of walls above a scanner's range: a synthetic street whose scan is cut at two degrees of elevation.

`python -m bench.facades [--seeds 0 1] [--degrees 2] [--out bench-out/facades]`

The result of the step `facades`, completed from the remaining points and the photos, is compared with the street's true
surface and with the removed wall points. Ends with `RESULT {json}`:

- **off_p95_m**, **far**: distance of synthesized points from the true surface, 95th percentile, and share of points
  farther than 30 cm, where there is no surface.
- **met**: share of the removed wall points within 30 cm of a synthesized one (without roofs, |nz| > .5).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.geometry.normals import oriented_normals
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.facades import FACADES
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.voxel import VOXEL
from tests.fakes.steps import step_params

STREET: dict[str, Any] = {"length": 30.0, "points": 1.2e6, "photos": 24}
MATCH_DISTANCE_M = 0.3
"""Distance from the truth beyond which a point is wrong, and within which a removed point is matched."""


def evaluate(folder: Path, seed: int, degrees: float) -> dict[str, float]:
    """Metrics of one street."""
    tile_at = folder / "tile"
    if not (tile_at / "tile.toml").is_file():
        generate(tile_at, **STREET, seed=seed)
    tile = read_tile(tile_at / "tile.toml")
    assert tile.trajectory is not None and tile.truth_mesh is not None

    def run_step(step: Step, inputs: dict[str, Path], name: str = "", **given: Any) -> Done:
        out = folder / (name or step.name)
        out.mkdir(exist_ok=True)
        return step.run(inputs, step_params(step.params, **given), out, silent)

    frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
    clouds = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
    whole = PointCloud.load(run_step(INGEST, clouds, **frame).files["cloud"])
    assert whole.time is not None and whole.classification is not None
    ray = whole.xyz - tile.trajectory.at(whole.time)
    low = np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])) <= np.radians(degrees)
    whole.take(low).save(folder / "cut.npz")
    tile.trajectory.save(folder / "path.npz")
    views_io.save(folder / "views.json", tile.views, [False] * len(tile.views))
    (folder / "labels").mkdir(exist_ok=True)
    parts = run_step(SPLIT, {"cloud": folder / "cut.npz"}).files
    thin = {
        part: run_step(VOXEL, {"cloud": path, "path": folder / "path.npz"}, f"voxel.{part}").files["cloud"]
        for part, path in parts.items()
    }
    inputs = {"cloud": thin.pop("building"), "path": folder / "path.npz"}
    inputs |= {"views": folder / "views.json", "labels": folder / "labels"}
    begin = time.process_time()
    done = run_step(FACADES, inputs | {f"other.{part}": path for part, path in thin.items()})
    seconds = time.process_time() - begin
    made, truth = PointCloud.load(done.files["synthesized"]), Mesh.load(tile.truth_mesh)
    off = distances(made.xyz, truth.moved_to(made.frame))
    walls = oriented_normals(
        sample(whole.take(~low & (whole.classification == CODE["building"])), 0.1), 16, tile.trajectory
    )
    assert walls.normal is not None
    walls = walls.take(np.abs(walls.normal[:, 2]) < 0.5)
    covered = np.isfinite(cKDTree(made.xyz).query(walls.xyz, distance_upper_bound=MATCH_DISTANCE_M)[0]).mean()
    metrics = {
        "off_p95_m": np.percentile(off, 95),
        "far": (off > MATCH_DISTANCE_M).mean(),
        "met": covered,
        "seconds": seconds,
    }
    print(f"seed {seed}: {done.metrics}; {json.dumps({k: round(float(v), 3) for k, v in metrics.items()})}")
    return {name: float(value) for name, value in metrics.items()}


def main() -> None:
    """Evaluate streets; print the metrics of each and their means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--degrees", type=float, default=2.0, help="elevation at which the scan is cut, degrees")
    parser.add_argument("--out", type=Path, default=Path("bench-out/facades"))
    arguments = parser.parse_args()
    rows = []
    for seed in arguments.seeds:
        folder = arguments.out / str(seed)
        folder.mkdir(parents=True, exist_ok=True)
        rows.append(evaluate(folder, seed, arguments.degrees))
    print("RESULT " + json.dumps({name: round(float(np.mean([r[name] for r in rows])), 3) for name in rows[0]}))


if __name__ == "__main__":
    main()
