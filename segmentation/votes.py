"""Votes: class probabilities of the photos, accumulated for each point that they see. Import late: loads numba.

A photo's vote is weighted by its distance and by the angle to the point's normal; visibility is tested with depth maps
(`pipeline.camera.depth_map`), as for texturing. A vote for sky at a point shows that the projection is wrong: it is
dropped, and the share of such votes is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.camera.image_sampling import allows, mixed, rescaled, taps
from scan2sim.pipeline.camera.models import EQUIRECTANGULAR
from scan2sim.pipeline.camera.projection import (
    PosedCamera,
    Ranges,
    incidence,
    is_visible,
    pixel_of,
    posed_camera,
    rotate_to_camera,
    to_camera,
)
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, U8, PointCloud, View
from scan2sim.pipeline.io.images import image
from scan2sim.segmentation.labels import CLASSES, SKY

VISIBILITY_BIAS_M = 0.12
"""Metres that a point may lie behind the depth map and still count as visible: its discs are of voxel size."""
DEPTH_MAP_PIXELS = 1_000_000
HALF_WEIGHT_DISTANCE_M = 12.0
"""Distance in metres at which a photo's vote has half the weight."""
MAX_DISTANCE_M = 80.0


@dataclass(frozen=True)
class Votes:
    """Votes of the photos for N points.

    Attributes:
        score: (N, C) float32 weighted sums of probabilities by class of `CLASSES`; 0 for the sky.
        weight: (N,) float32 sums of weights.
        sky_share: share of the observations that show sky.
    """

    score: F32
    weight: F32
    sky_share: float


def vote(
    cloud: PointCloud,
    views: Sequence[View],
    probabilities: Path,
    *,
    radius: float,
    moving: PointCloud | None = None,
    report: Report = silent,
) -> Votes:
    """Accumulate the votes of all classified photos.

    Args:
        cloud: cloud with normals, about one point per voxel.
        views: all views, by index; views without a file have no vote.
        probabilities: folder of `<view index>.npy`, (h, w, C) uint8.
        radius: radius in metres of the discs by which points hide others: about the voxel size.
        moving: moving points from the step `dynamic_objects`, which hide others at the time of their scan.
        report: progress callback.
    """
    occluders = scene([], cloud, radius=radius, moving=moving)
    score = np.zeros((len(cloud), len(CLASSES)), np.float32)
    weight = np.zeros(len(cloud), np.float32)
    assert cloud.normal is not None
    seen = sky = 0
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        file = probabilities / f"{i}.npy"
        if not file.is_file():
            continue
        depth = depth_map(view.camera, view.T_world_cam, occluders, time=view.time, pixels=DEPTH_MAP_PIXELS)
        camera = posed_camera(view.camera, view.T_world_cam)
        counted = _vote(score, weight, cloud.xyz, cloud.normal, camera, depth.ranges, np.load(file), _mask(view))
        seen, sky = seen + int(counted[0]), sky + int(counted[1])
    return Votes(score, weight, sky / seen if seen else 0.0)


def _mask(view: View) -> np.ndarray:
    mask = image.read_mask(view)
    return np.zeros((0, 0), np.uint8) if mask is None else mask


@njit(cache=True, parallel=True)
def _vote(
    score: F32, weight: F32, xyz: F32, normals: F32, camera: PosedCamera, ranges: Ranges, probabilities: U8, mask: U8
) -> tuple[int, int]:
    """Add a photo's votes in place; returns (number of points seen, number of points that show sky)."""
    n, classes = score.shape
    observed = np.zeros(n, np.uint8)
    for i in prange(n):
        x, y, z = to_camera(camera.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        d2 = x * x + y * y + z * z
        if not 0.25 < d2 < MAX_DISTANCE_M * MAX_DISTANCE_M:
            continue
        u, v, ok = pixel_of(camera, x, y, z)
        if not ok or not allows(mask, camera.p, u, v):
            continue
        nx, ny, nz = rotate_to_camera(camera.T, normals[i, 0], normals[i, 1], normals[i, 2])
        distance, cos = incidence(camera, x, y, z, nx, ny, nz)
        if not is_visible(camera, ranges, u, v, distance, cos, VISIBILITY_BIAS_M):
            continue
        w = (0.2 + 0.8 * abs(cos)) / (1 + d2 / (HALF_WEIGHT_DISTANCE_M * HALF_WEIGHT_DISTANCE_M))
        s, t = rescaled(camera.p, u, v, probabilities)
        at = taps(probabilities, s, t, camera.model == EQUIRECTANGULAR)
        sky_probability = mixed(probabilities, SKY, at) / 255.0
        if sky_probability > 0.5:
            observed[i] = 2
            continue
        observed[i] = 1
        for k in range(classes):
            if k != SKY:
                score[i, k] += w * mixed(probabilities, k, at) / 255.0
        weight[i] += w * (1 - sky_probability)
    return (observed > 0).sum(), (observed == 2).sum()
