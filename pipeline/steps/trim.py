"""Trim: remove what Poisson made where no points are (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.parameters import Reach, Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, Mesh, PointCloud

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


MISSION_VOXEL = 0.10  # metres, the voxels that the limits are made for (D3.2)
FULL_VOXELS = 1.4  # mean distance to six neighbours on a surface whose every voxel holds a point, in voxels


class TrimParams(Params):
    """What is removed, all in metres.

    The limits suit a cloud that fills voxels of 10 cm, as a mobile scanner's does. Where the points lie
    sparser than that, or are thinned to larger voxels, limits grow in proportion (the fact `widened` tells how much).

    Attributes:
        max_edge: of a triangle; the mission's 50 cm for terrain (holes get closed), 25 cm else.
        max_distance: of a vertex to the nearest point.
        max_spacing: of the points around a vertex, as Poisson's density tells it.
        voxel: size that the cloud was thinned to; set by the recipe.
    """

    max_edge: Reach = 0.25
    max_distance: Reach = 0.25
    max_spacing: Reach = 0.8
    voxel: Voxel = 0.10


def trim(inputs: Inputs, params: TrimParams, out: Path, report: Report) -> Done:
    """Keep the triangles of `mesh` that the points of `cloud`, or those made up (`made`, optional), bear out."""
    from scipy.spatial import cKDTree

    mesh, cloud = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"])
    if len(mesh) == 0:
        mesh.save(out / "mesh.npz")
        return Done({"mesh": out / "mesh.npz"}, {"faces_in": 0, "faces": 0})
    assert mesh.density is not None
    tree = cKDTree(cloud.xyz)
    widened = max(1.0, _spacing(tree, cloud.xyz) / (FULL_VOXELS * MISSION_VOXEL))
    if "made" in inputs:
        tree = cKDTree(np.concatenate([cloud.xyz, PointCloud.load(inputs["made"]).xyz]))
    corners = mesh.corners
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    long = edge > params.max_edge * widened
    # a density of d means that the samples fill cells of half a voxel times 2^(finest depth - d)
    spacing = params.voxel / 2 * 2.0 ** (mesh.density.max() - mesh.density)
    sparse = (spacing > params.max_spacing * widened)[mesh.faces].any(axis=1)
    report(0.3, "distances")
    keep = mesh.keep(~(long | sparse))
    distance, _ = tree.query(keep.vertices, distance_upper_bound=params.max_distance * widened, workers=-1)
    far = ~np.isfinite(distance)[keep.faces].all(axis=1)
    keep = keep.keep(~far)
    keep.save(out / "mesh.npz")
    facts = {
        "faces_in": len(mesh),
        "faces": len(keep),
        "long_edges": int(long.sum()),
        "sparse": int((sparse & ~long).sum()),
        "far_from_points": int(far.sum()),
        "widened": round(widened, 2),
    }
    return Done({"mesh": out / "mesh.npz"}, facts)


def _spacing(tree: cKDTree, xyz: F32) -> float:
    """Median over points of the mean distance to six neighbours, metres, from a sample of the points."""
    some = xyz[:: max(1, len(xyz) // 20_000)]
    distance, _ = tree.query(some, k=min(7, len(xyz)), workers=-1)
    return float(np.median(distance[:, 1:].mean(axis=1)))


TRIM = Step(
    "trim",
    2,
    trim,
    TrimParams,
    class_defaults={"terrain": {"max_edge": 0.5, "max_distance": 0.5, "max_spacing": 1.6}},
    per_class=True,
    memory=(0.4, 12),
)
