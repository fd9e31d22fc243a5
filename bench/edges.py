"""Straightness of a world's building edges, compared with the true edges of a generated street.

`python -m bench.edges STREET RUN [--before RUN2]`: STREET is the output of `scan2sim sample`, RUN that of `scan2sim
run`. Evaluated are scanned edges of the true surface (creases of at least 30 degrees, and boundary edges) whose sides
are flat for 30 cm ("main": corners, eaves, ridges) or only for 12 cm ("fine": reveals, ledges).
Ends with `RESULT {json}`: `edge_cm`, the 90th percentile of the distance from points on main edges to the nearest edge
of the mesh (a crease of 30 degrees, or a boundary edge).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, Mesh, PointCloud
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.geometry import truth_error

CREASE_COS = float(np.cos(np.radians(30.0)))
BUILDING = 6
SPACING_M = 0.04  # distance between samples along an edge
MAIN_WIDTH_M, FINE_WIDTH_M = 0.30, 0.12  # width for which both sides of an edge are flat
RAY_OFFSET_M = 0.01  # distance from the surface at which rays start
SCANNED_DISTANCE_M = 0.05  # maximum distance to the nearest points, on both sides
SIDE_RADIUS_M = 0.15  # radius in which points of a side are searched
GOOD_M = 0.03
BESIDE_M = 0.20
STRAY_M = 0.10
SAMPLES = 200_000


@dataclass(frozen=True)
class EdgeSamples:
    """Samples along true edges: xyz (N, 3), and whether both sides are flat for `MAIN_WIDTH_M` (N,)."""

    xyz: F64
    main: np.ndarray


def main() -> None:
    """Evaluate one run, or compare two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("street", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--before", type=Path, help="another run of the same street")
    given = parser.parse_args()
    result = {}
    for name, folder in (("before", given.before), ("after", given.run)):
        if folder is not None:
            result[name] = metrics(given.street, mesh_of(folder), points_of(folder))
            print(name, json.dumps(result[name]), flush=True)
    answer = result["after"] | {f"{k}_before": v for k, v in result.get("before", {}).items()}
    print("RESULT " + json.dumps(answer))


def mesh_of(run: Path, group: str = "building") -> Mesh:
    """Mesh of a class in a run."""
    return Mesh.load(_newest(run, f"decimate.{group}", "mesh.npz"))


def points_of(run: Path, group: str = "building") -> PointCloud:
    """Input points of a class in a run."""
    return PointCloud.load(_newest(run, "split", f"{group}.npz"))


def _newest(run: Path, step: str, file: str) -> Path:
    return max((run / "steps" / step).glob(f"*/{file}"), key=lambda path: path.stat().st_mtime)


def metrics(street: Path, mesh: Mesh, cloud: PointCloud) -> dict[str, Any]:
    """Metrics of a building mesh: distances from true edges to its edges, and from the true surface beside them."""
    truth_file = read_tile(street).truth_mesh
    assert truth_file is not None
    truth = Mesh.load(truth_file).moved_to(mesh.frame)
    assert truth.classification is not None
    samples = true_edges(truth.keep(truth.classification == BUILDING), cloud.xyz)
    folds = crease_samples(mesh)
    distance, _ = cKDTree(folds).query(samples.xyz, workers=-1)
    off = distances(samples.xyz.astype(np.float32), mesh)
    beside = _beside(truth, samples.xyz[samples.main], cloud.xyz)
    missed = distances(beside, mesh)
    answer: dict[str, Any] = {}
    for name, chosen in (("", samples.main), ("fine_", ~samples.main)):
        answer |= {
            f"{name}edge_cm": _cm(np.percentile(distance[chosen], 90)),
            f"{name}edge_median_cm": _cm(np.median(distance[chosen])),
            f"{name}edges_within_3cm": round(float((distance[chosen] < GOOD_M).mean()), 3),
            f"{name}rounded_cm": _cm(np.percentile(off[chosen], 90)),
            f"{name}edges_m": round(float(chosen.sum() * SPACING_M), 1),
        }
    away, _ = cKDTree(samples.xyz).query(folds, workers=-1)
    return answer | {
        "stray_m_per_m2": round(float((away > STRAY_M).sum() * SPACING_M / mesh.face_area.sum()), 3),
        "beside_mean_cm": _cm(missed.mean()),
        "beside_p90_cm": _cm(np.percentile(missed, 90)),
        "truth_cm": _cm(truth_error(mesh, truth, "building", SAMPLES) or np.nan),
        "triangles": len(mesh),
    }


def _cm(metres: Any) -> float:
    return round(float(metres) * 100, 2)


def true_edges(truth: Mesh, xyz: F32) -> EdgeSamples:
    """Samples along edges of a true surface that have points `xyz` (N, 3) on both sides.

    The surface consists of parts that touch without sharing vertices, so edges are found by ray casting: a side is
    flat as far as rays against it hit the surface where expected.
    """
    scene = _scene(truth)
    corners, normal = truth.corners.astype(np.float64), truth.face_normal.astype(np.float64)
    starts: list[F64] = []
    ends: list[F64] = []
    normals: list[F64] = []
    inwards: list[F64] = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-9)
        for values, value in zip(
            (starts, ends, normals, inwards), (a, b, normal, np.cross(normal, along)), strict=True
        ):
            values.append(value)
    a, b, n, u = (np.concatenate(part) for part in (starts, ends, normals, inwards))
    long = np.linalg.norm(b - a, axis=1) > FINE_WIDTH_M
    a, b, n, u = a[long], b[long], n[long], u[long]
    count = np.ceil(np.linalg.norm(b - a, axis=1) / SPACING_M).astype(int)
    which = np.repeat(np.arange(len(a)), count)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    e, n, u = a[which] + share[:, None] * (b - a)[which], n[which], u[which]
    ok = ~_flat(scene, e, n, -u, RAY_OFFSET_M * 2) & _flat(scene, e, n, u, FINE_WIDTH_M)  # the flat side ends here
    e, n, u = e[ok], n[ok], u[ok]
    tree = cKDTree(xyz)
    close, _ = tree.query(e, workers=-1)
    e, n, u = e[close < SCANNED_DISTANCE_M], n[close < SCANNED_DISTANCE_M], u[close < SCANNED_DISTANCE_M]
    lists = tree.query_ball_point(e, SIDE_RADIUS_M, workers=-1)
    mine = np.array([_lies(xyz[i], p, m, v) for i, p, m, v in zip(lists, e, n, u, strict=True)], bool)
    e, n, u = e[mine], n[mine], u[mine]
    wide = _flat(scene, e, n, u, MAIN_WIDTH_M)
    # samples of a crease exist for both of its sides, with different normals
    pairs = cKDTree(e).query_ball_point(e, 0.025, workers=-1)
    crease = np.array([bool((np.abs(n[i] @ n[j]) < CREASE_COS).any()) for j, i in enumerate(pairs)], bool)
    broad = np.array([bool((wide[i] & (np.abs(n[i] @ n[j]) < CREASE_COS)).any()) for j, i in enumerate(pairs)], bool)
    free = ~crease & _free(scene, e, n, u)
    keep = crease | free
    samples, is_main = e[keep], (wide & (broad | free))[keep]
    _, first = np.unique(np.round(samples / SPACING_M).astype(np.int64), axis=0, return_index=True)
    return EdgeSamples(samples[first], is_main[first])


def _lies(points: F32, place: F64, normal: F64, inward: F64) -> bool:
    """Whether there are points on an edge's side."""
    apart = points - place
    return bool(((np.abs(apart @ normal) < 0.03) & (apart @ inward > 0.02)).any())


def _scene(mesh: Mesh) -> Any:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    return scene


def _flat(scene: Any, e: F64, n: F64, u: F64, wide: float) -> np.ndarray:
    """(N,) whether the surface is flat from positions `e` for `wide` metres along `u`, with normal `n`."""
    flat = np.ones(len(e), bool)
    for share in (1.0, 0.75, 0.5, 0.25) if wide > 3 * RAY_OFFSET_M else (1.0,):
        origin = e + share * wide * u + RAY_OFFSET_M * n
        answer = scene.cast_rays(np.concatenate([origin, -n], axis=1).astype(np.float32))
        same = np.abs(answer["t_hit"].numpy() - RAY_OFFSET_M) < RAY_OFFSET_M / 4
        flat &= same & (np.abs((answer["primitive_normals"].numpy() * n).sum(axis=1)) > 0.98)
    return flat


def _free(scene: Any, e: F64, n: F64, u: F64) -> np.ndarray:
    """(N,) whether there is nothing beyond the positions."""
    origin = e - 2 * RAY_OFFSET_M * u + 5 * RAY_OFFSET_M * n
    answer = scene.cast_rays(np.concatenate([origin, -n], axis=1).astype(np.float32))
    return answer["t_hit"].numpy() > 0.5


def crease_samples(mesh: Mesh) -> F64:
    """(N, 3) samples along the creases of 30 degrees and boundary edges of a mesh."""
    ends = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort(ends.T)
    ends, face = ends[order], np.repeat(np.arange(len(mesh)), 3)[order]
    first = np.flatnonzero(np.append(True, (ends[1:] != ends[:-1]).any(axis=1)))
    number = np.diff(np.append(first, len(ends)))
    normal = mesh.face_normal
    fold = number != 2
    two = first[number == 2]
    fold[number == 2] = (normal[face[two]] * normal[face[two + 1]]).sum(axis=1) < CREASE_COS
    a, b = mesh.vertices[ends[first[fold]]].astype(np.float64).transpose(1, 0, 2)
    count = np.maximum(1, np.ceil(np.linalg.norm(b - a, axis=1) / SPACING_M).astype(int))
    which = np.repeat(np.arange(len(a)), count)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    return a[which] + share[:, None] * (b - a)[which]


def _beside(truth: Mesh, edges: F64, xyz: F32) -> F32:
    """Samples of the true surface within `BESIDE_M` of edges, where it was scanned."""
    assert truth.classification is not None
    points = sample_surface(truth.keep(truth.classification == BUILDING), 20 * SAMPLES)
    close, _ = cKDTree(edges).query(points, distance_upper_bound=BESIDE_M, workers=-1)
    points = points[np.isfinite(close)]
    seen, _ = cKDTree(xyz).query(points, distance_upper_bound=SCANNED_DISTANCE_M, workers=-1)
    return points[np.isfinite(seen)]


if __name__ == "__main__":
    main()
