"""Votes: what the photos' probabilities say of each point that they see. Import late: loads numba.

A photo's word counts by how near and how squarely it sees the point; who sees it, `pipeline.visibility` tells, as for
texturing. A vote for the sky on a point that is there proves a projection wrong: it is dropped, and its share told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.cameras import EQUIRECTANGULAR, MODEL_ID, parameters, pixel_angle, project_point
from scan2sim.pipeline.range_image import is_visible
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import F32, PointCloud, View
from scan2sim.pipeline.visibility import depth_map, scene
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
    labels: Path,
    *,
    radius: float,
    moving: PointCloud | None = None,
    report: Report = silent,
) -> Votes:
    """Ask all photos that have been labelled.

    Args:
        cloud: with normals; thinned to about one point a voxel.
        views: all, by index; those without a file are not asked.
        labels: folder of `<view index>.npy`, (h, w, C) uint8.
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
        file = labels / f"{i}.npy"
        if not file.is_file():
            continue
        camera = view.camera
        depth = depth_map(camera, view.T_world_cam, hides, time=view.time, pixels=PIXELS)
        told = _ask(
            score, weight, cloud.xyz, cloud.normal, np.linalg.inv(view.T_world_cam), np.load(file),
            MODEL_ID[camera.model], parameters(camera), depth.range, parameters(depth.camera),
            pixel_angle(depth.camera), _mask(view),
        )  # fmt: skip
        seen, sky = seen + int(told[0]), sky + int(told[1])
    return Votes(score, weight, sky / seen if seen else 0.0)


def _mask(view: View) -> np.ndarray:
    from scan2sim.pipeline.io import image

    mask = image.read_mask(view) if view.mask is not None else None
    return np.zeros((0, 0), np.uint8) if mask is None else mask


@njit(cache=True, parallel=True)
def _ask(score, weight, xyz, normals, T, labels, model, p, depth, depth_p, pixel, mask):  # type: ignore[no-untyped-def]
    """Add a photo's votes in place; returns (points seen, those that it takes for sky)."""
    n, classes = score.shape
    wide = model == EQUIRECTANGULAR
    rows, columns = labels.shape[0], labels.shape[1]
    kind = np.zeros(n, np.uint8)
    for i in prange(n):
        a, b, c = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        d2 = x * x + y * y + z * z
        if not 0.25 < d2 < FAR * FAR:
            continue
        u, v, ok = project_point(model, p, x, y, z)
        if not ok or v < -0.5 or v >= p[13] - 0.5 or ((u < -0.5 or u >= p[12] - 0.5) and not wide):
            continue
        if mask.shape[0] > 0 and mask[int(v + 0.5), int(u + 0.5) % mask.shape[1]] == 0:
            continue
        e, f, g = normals[i, 0], normals[i, 1], normals[i, 2]
        nx = T[0, 0] * e + T[0, 1] * f + T[0, 2] * g
        ny = T[1, 0] * e + T[1, 1] * f + T[1, 2] * g
        nz = T[2, 0] * e + T[2, 1] * f + T[2, 2] * g
        if not is_visible(depth, model, depth_p, pixel, BIAS, x, y, z, nx, ny, nz):
            continue
        distance = math.sqrt(d2)
        cos = abs(x * nx + y * ny + z * nz) / distance
        w = (0.2 + 0.8 * cos) / (1 + d2 / (NEAR * NEAR))
        s, t = (u + 0.5) * columns / p[12] - 0.5, (v + 0.5) * rows / p[13] - 0.5
        s0, t0 = math.floor(s), math.floor(t)
        fs, ft = s - s0, t - t0
        a0, a1, b0, b1 = int(s0), int(s0) + 1, int(t0), int(t0) + 1
        if wide:
            a0, a1 = a0 % columns, a1 % columns
        else:
            a0, a1 = min(max(a0, 0), columns - 1), min(max(a1, 0), columns - 1)
        b0, b1 = min(max(b0, 0), rows - 1), min(max(b1, 0), rows - 1)
        w00, w10, w01, w11 = (1 - fs) * (1 - ft), fs * (1 - ft), (1 - fs) * ft, fs * ft
        up = (
            labels[b0, a0, SKY] * w00 + labels[b0, a1, SKY] * w10
            + labels[b1, a0, SKY] * w01 + labels[b1, a1, SKY] * w11
        ) / 255.0  # fmt: skip
        if up > 0.5:
            kind[i] = 2
            continue
        kind[i] = 1
        for k in range(classes):
            if k != SKY:
                score[i, k] += w * (
                    labels[b0, a0, k] * w00 + labels[b0, a1, k] * w10
                    + labels[b1, a0, k] * w01 + labels[b1, a1, k] * w11
                ) / 255.0  # fmt: skip
        weight[i] += w * (1 - up)
    return (kind > 0).sum(), (kind == 2).sum()
