"""Votes: what the photos' probabilities say of each point that they see. Import late: loads numba.

A photo's word counts by how near and how squarely it sees the point; who sees it, `pipeline.camera.depth_map` decides,
as for
texturing. A vote for the sky on a point that is there proves a projection wrong: it is dropped, and its share reported.
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
from scan2sim.pipeline.camera.projection import Eye, Ranges, eye, incidence, is_visible, pixel_of, to_camera, turned
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, U8, PointCloud, View
from scan2sim.pipeline.io.images import image
from scan2sim.segmentation.labels import CLASSES, SKY

BIAS = 0.12
"""Metres that a point may lie behind the discs and still count as seen: they are of voxels, and rough."""
PIXELS = 1_000_000
NEAR = 12.0
"""Metres at which a photo's word counts half."""
FAR = 80.0


@dataclass(frozen=True)
class Votes:
    """What photos say of N points.

    Attributes:
        score: (N, C) float32, weighted sums of probabilities by class of `CLASSES`; 0 for the sky.
        weight: (N,) float32, sums of weights.
        sky: share of the sightings that say sky.
    """

    score: F32
    weight: F32
    sky: float


def vote(
    cloud: PointCloud,
    views: Sequence[View],
    probabilities: Path,
    *,
    radius: float,
    moving: PointCloud | None = None,
    report: Report = silent,
) -> Votes:
    """Collect the votes of all photos that have been classified.

    Args:
        cloud: with normals; thinned to about one point a voxel.
        views: all, by index; those without a file have no vote.
        probabilities: folder of `<view index>.npy`, (h, w, C) uint8.
        radius: metres, of the discs that points hide by: about the voxel's size.
        moving: what the step `carve` found moving: it hides, too, while it is there.
        report: progress.
    """
    hides = scene([], cloud, radius=radius, moving=moving)
    score = np.zeros((len(cloud), len(CLASSES)), np.float32)
    weight = np.zeros(len(cloud), np.float32)
    assert cloud.normal is not None
    seen = sky = 0
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        file = probabilities / f"{i}.npy"
        if not file.is_file():
            continue
        depth = depth_map(view.camera, view.T_world_cam, hides, time=view.time, pixels=PIXELS)
        sees = eye(view.camera, view.T_world_cam)
        counted = _vote(score, weight, cloud.xyz, cloud.normal, sees, depth.ranges, np.load(file), _mask(view))
        seen, sky = seen + int(counted[0]), sky + int(counted[1])
    return Votes(score, weight, sky / seen if seen else 0.0)


def _mask(view: View) -> np.ndarray:
    mask = image.read_mask(view)
    return np.zeros((0, 0), np.uint8) if mask is None else mask


@njit(cache=True, parallel=True)
def _vote(
    score: F32, weight: F32, xyz: F32, normals: F32, eye: Eye, ranges: Ranges, probabilities: U8, mask: U8
) -> tuple[int, int]:
    """Add a photo's votes in place; returns (points seen, those that it takes for sky)."""
    n, classes = score.shape
    kind = np.zeros(n, np.uint8)
    for i in prange(n):
        x, y, z = to_camera(eye.T, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        d2 = x * x + y * y + z * z
        if not 0.25 < d2 < FAR * FAR:
            continue
        u, v, ok = pixel_of(eye, x, y, z)
        if not ok or not allows(mask, eye.p, u, v):
            continue
        nx, ny, nz = turned(eye.T, normals[i, 0], normals[i, 1], normals[i, 2])
        distance, cos = incidence(eye, x, y, z, nx, ny, nz)
        if not is_visible(eye, ranges, u, v, distance, cos, BIAS):
            continue
        w = (0.2 + 0.8 * abs(cos)) / (1 + d2 / (NEAR * NEAR))
        s, t = rescaled(eye.p, u, v, probabilities)
        at = taps(probabilities, s, t, eye.model == EQUIRECTANGULAR)
        up = mixed(probabilities, SKY, at) / 255.0
        if up > 0.5:
            kind[i] = 2
            continue
        kind[i] = 1
        for k in range(classes):
            if k != SKY:
                score[i, k] += w * mixed(probabilities, k, at) / 255.0
        weight[i] += w * (1 - up)
    return (kind > 0).sum(), (kind == 2).sum()
