"""Libraries that decimate, side by side, on the meshes of a world that was made.

`python -m bench.decimation OUT [--classes terrain building] [--shares 0.5 0.15] [--only pyfqmr ...]`: OUT is what
`scan2sim run` wrote (`make demo`: demo-out, of the synthetic street). What `decimate` reads there, the result of
`islands`, is brought to shares of its triangles by every library that can run here, borders kept where it can.

- seconds: of the collapse alone, the best of two.
- away: metres from 100,000 places of the mesh as it was to the new one; mean, 95 % are nearer, farthest.
- border: share of the edges of one face alone that are still there, to the bit.
- turned: share of the new mesh's area that looks away (by more than a right angle) from the nearest face there was.

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
from scan2sim.pipeline.steps.collision import deviation
from scan2sim.pipeline.tiling.borders.boundary_curve import curve


def read(out: Path, group: str) -> Mesh:
    """What `decimate` read of a class."""
    found = max((out / "steps" / f"islands.{group}").glob("*/mesh.npz"), key=lambda path: path.stat().st_mtime)
    mesh = Mesh.load(found)
    return Mesh(mesh.frame, mesh.vertices, mesh.faces)


def border(mesh: Mesh) -> set[frozenset[tuple[float, ...]]]:
    """The edges of one face alone, by their places."""
    edges = curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges
    return {frozenset(map(tuple, ends)) for ends in mesh.vertices[edges].tolist()}


def turned(small: Mesh, whole: Mesh) -> float:
    """Share of an area that looks away from the nearest face of `whole`."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    faces = o3d.core.Tensor.from_numpy(whole.faces.astype(np.uint32))
    scene.add_triangles(o3d.core.Tensor.from_numpy(whole.vertices), faces)
    middles = o3d.core.Tensor.from_numpy(small.corners.mean(axis=1).astype(np.float32))
    nearest = scene.compute_closest_points(middles)["primitive_ids"].numpy().astype(np.int64)
    away = np.einsum("ij,ij->i", small.face_normal, whole.face_normal[nearest]) < 0
    return float(small.face_area[away].sum() / small.face_area.sum())


def figures(whole: Mesh, name: str, target: int) -> dict[str, Any]:
    """Of one library."""
    keeps = plugins.module(decimation.__name__, name).KEEPS_BORDER
    took = []
    for _ in range(2):
        start = time.perf_counter()
        small = decimation.simplify(whole, target, keep_border=keeps, backend=name)
        took.append(time.perf_counter() - start)
    edges = border(whole)
    return {
        "faces": len(small),
        "seconds": round(min(took), 2),
        "away_m": deviation(whole, small, 0),
        "border": round(len(edges & border(small)) / max(len(edges), 1), 4),
        "turned": round(turned(small, whole), 6),
    }


def main() -> None:
    """Print the table."""
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
                lacking = plugins.missing(decimation.__name__, name)
                if lacking:
                    print(f"  {name:20s} needs {lacking}")
                    continue
                one = figures(whole, name, round(share * len(whole)))
                result.setdefault(name, {})[f"{group} {share:g}"] = one
                print(f"  {name:20s}", json.dumps(one), flush=True)
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
