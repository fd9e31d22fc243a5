"""Coarse surface: faces at points that photos don't cover, which are thinned (`pipeline.steps.photo_coverage`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, Bools, Mesh, PointCloud

COARSE_VOXELS = 3.0
"""Spacing of uncovered points, in voxels of covered ones: 30 cm at 10 cm, a tenth of the triangles."""


def coarse_spacing(voxel: float) -> float:
    """Voxel size in metres of points that photos don't cover, for the voxel size of the others."""
    return COARSE_VOXELS * voxel


def is_coarse(mesh: Mesh, covered: F32, uncovered: F32) -> Bools:
    """(F,) bool, True for faces whose centroid is nearer to `uncovered` (M, 3) than to `covered` (N, 3) points."""
    from scipy.spatial import cKDTree

    if not len(mesh) or not len(uncovered):
        return np.zeros(len(mesh), bool)
    centroid = mesh.corners.mean(axis=1)
    to_uncovered, _ = cKDTree(uncovered).query(centroid, workers=-1)
    if not len(covered):
        return np.ones(len(mesh), bool)
    to_covered, _ = cKDTree(covered).query(centroid, workers=-1)
    return np.asarray(to_uncovered < to_covered)


def coarse_faces(mesh: Mesh, inputs: Mapping[str, Path]) -> Bools:
    """(F,) bool, faces at the points `uncovered` of a step's inputs rather than at those of its `cloud`, `cloud.*`."""
    if "uncovered" not in inputs:
        return np.zeros(len(mesh), bool)
    covered = [PointCloud.load(inputs[name]).xyz for name in sorted(inputs) if name.split(".")[0] == "cloud"]
    return is_coarse(mesh, np.concatenate(covered), PointCloud.load(inputs["uncovered"]).xyz)
