"""Compare decimation libraries on the meshes of a finished world.

`python -m bench.decimation OUT [--classes terrain building] [--shares 0.5 0.15] [--only NAME ...]`: OUT is the output
of `scan2sim run` (`make demo`: demo-out, the synthetic street). The input of `decimate`, which is the result of
`islands`, is reduced to shares of its triangles by every available library, keeping borders.

- seconds: time of the edge collapse alone, the better of two runs.
- away: distances in metres from 100,000 points of the original mesh to the new one: mean, 95 %, maximum.
- border: share of the boundary edges that are preserved exactly.
- turned: share of the new mesh's area facing away (more than a right angle) from the nearest original face.

Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline import decimation
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.geometry.surface_distance import deviation


def read(out: Path, group: str) -> Mesh:
    """Input of `decimate` for a class."""
    found = max((out / "steps" / f"islands.{group}").glob("*/mesh.npz"), key=lambda path: path.stat().st_mtime)
    mesh = Mesh.load(found)
    return Mesh(mesh.frame, mesh.vertices, mesh.faces)


def border(mesh: Mesh) -> set[frozenset[tuple[float, ...]]]:
    """Boundary edges (of one face only), by the coordinates of their ends."""
    edges = curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges
    return {frozenset(map(tuple, ends)) for ends in mesh.vertices[edges].tolist()}


def share_facing_away(small: Mesh, whole: Mesh) -> float:
    """Share of the area facing away from the nearest face of `whole`."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    faces = o3d.core.Tensor.from_numpy(whole.faces.astype(np.uint32))
    scene.add_triangles(o3d.core.Tensor.from_numpy(whole.vertices), faces)
    middles = o3d.core.Tensor.from_numpy(small.corners.mean(axis=1).astype(np.float32))
    nearest = scene.compute_closest_points(middles)["primitive_ids"].numpy().astype(np.int64)
    away = np.einsum("ij,ij->i", small.face_normal, whole.face_normal[nearest]) < 0
    return float(small.face_area[away].sum() / small.face_area.sum())


def metrics(whole: Mesh, name: str, target: int) -> dict[str, Any]:
    """Metrics of one library."""
    took = []
    for _ in range(2):
        start = time.perf_counter()
        small = decimation.simplify(whole, target, backend=name)
        took.append(time.perf_counter() - start)
    edges = border(whole)
    return {
        "faces": len(small),
        "seconds": round(min(took), 2),
        "away_m": deviation(whole, small, 0),
        "border": round(len(edges & border(small)) / max(len(edges), 1), 4),
        "turned": round(share_facing_away(small, whole), 6),
    }


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--classes", nargs="*", default=["terrain", "building"])
    parser.add_argument("--shares", type=float, nargs="*", default=[0.5, 0.15])
    parser.add_argument("--only", nargs="*", default=plugins.names(decimation.__name__))
    given = parser.parse_args()
    result: dict[str, Any] = {}
    for group in given.classes:
        whole = read(given.out, group)
        for share in given.shares:
            print(f"{group}, {len(whole):,} triangles to {share:.0%}")
            for name in given.only:
                missing = plugins.missing(decimation.__name__, name)
                if missing:
                    print(f"  {name:20s} needs {missing}")
                    continue
                one = metrics(whole, name, round(share * len(whole)))
                result.setdefault(name, {})[f"{group} {share:g}"] = one
                print(f"  {name:20s}", json.dumps(one), flush=True)
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
