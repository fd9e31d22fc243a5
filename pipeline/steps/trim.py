"""Trim: removes Poisson surface that is not supported by points (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F32, Mesh, PointCloud
from scan2sim.pipeline.geometry.coarse_surface import coarse_spacing

REFERENCE_VOXEL_M = 0.10  # voxel size that the limits are made for (D3.2)
FULL_SPACING_VOXELS = 1.4  # mean distance to six neighbours on a surface with a point in every voxel


class TrimParams(Params):
    """Limits for faces, in metres.

    The limits are for a cloud with a point in every 10 cm voxel, as from a mobile scanner. For sparser clouds or larger
    voxels, they are scaled up in proportion (metric `widened`); so they are near uncovered points, which are thinned.

    Attributes:
        max_edge: maximum edge length of a triangle; D3.2: 50 cm for terrain (closes holes), 25 cm otherwise.
        max_distance: maximum distance of a vertex to the nearest point.
        max_spacing: maximum point spacing around a vertex, from the density of the Poisson reconstruction.
    """

    max_edge: Distance = 0.25
    max_distance: Distance = 0.25
    max_spacing: Distance = 0.8
    context: ThinnedCloud = ThinnedCloud()


def trim(inputs: Inputs, params: TrimParams, out: Path, report: Report) -> Done:
    """Keep the triangles of `mesh` that are supported by points of `cloud`, or by optional points.

    These are `synthesized` ones, and `uncovered` ones, which are thinned: near those, the limits are scaled up, except
    for the distance, which is at most their spacing.
    """
    from scipy.spatial import cKDTree

    mesh, cloud = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"])
    if len(mesh) == 0:
        mesh.save(out / "mesh.npz")
        return Done({"mesh": out / "mesh.npz"}, {"faces_in": 0, "faces": 0})
    assert mesh.density is not None
    voxel = params.context.voxel
    widened = max(1.0, _spacing(cloud.xyz) / (FULL_SPACING_VOXELS * REFERENCE_VOXEL_M))
    report(0.1, "distances")
    distance, scale = np.full(len(mesh.vertices), np.inf), np.full(len(mesh.vertices), widened)
    coarse = coarse_spacing(voxel)
    limits = dict.fromkeys(("cloud", "synthesized"), (params.max_distance * widened, widened))
    limits["uncovered"] = max(params.max_distance * widened, coarse), max(widened, coarse / REFERENCE_VOXEL_M)
    for name, (max_distance, own_scale) in limits.items():
        if name in inputs and len(points := PointCloud.load(inputs[name])):
            to_points, _ = cKDTree(points.xyz).query(mesh.vertices, distance_upper_bound=max_distance, workers=-1)
            scale[to_points < distance] = own_scale
            distance = np.minimum(distance, to_points)
    corners = mesh.corners
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    long = edge > params.max_edge * scale[mesh.faces].max(axis=1)
    # a density of d means that the samples fill cells of half a voxel times 2^(finest depth - d)
    spacing = voxel / 2 * 2.0 ** (mesh.density.max() - mesh.density)
    sparse = (spacing > params.max_spacing * scale)[mesh.faces].any(axis=1)
    far = ~np.isfinite(distance)[mesh.faces].all(axis=1) & ~long & ~sparse
    keep = mesh.keep(~(long | sparse | far))
    keep.save(out / "mesh.npz")
    metrics = {
        "faces_in": len(mesh),
        "faces": len(keep),
        "long_edges": int(long.sum()),
        "sparse": int((sparse & ~long).sum()),
        "far_from_points": int(far.sum()),
        "widened": round(widened, 2),
    }
    return Done({"mesh": out / "mesh.npz"}, metrics)


def _spacing(xyz: F32) -> float:
    """Median over points of the mean distance to six neighbours, metres, from a sample of the points."""
    from scipy.spatial import cKDTree

    if len(xyz) < 2:
        return 0.0
    distance, _ = cKDTree(xyz).query(xyz[:: max(1, len(xyz) // 20_000)], k=min(7, len(xyz)), workers=-1)
    return float(np.median(distance[:, 1:].mean(axis=1)))


TRIM = Step(
    "trim",
    3,
    trim,
    TrimParams,
    class_defaults={"terrain": {"max_edge": 0.5, "max_distance": 0.5, "max_spacing": 1.6}},
    per_class=True,
    memory=(0.4, 12),
)
