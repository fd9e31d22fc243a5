"""Colours that points lend to texels which no photo saw. Import late: it loads numba."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.step import Inputs
from scan2sim.pipeline.core.types import F32, U8, PointCloud
from scan2sim.texturing.inpainting.ground import Plan
from scan2sim.texturing.inpainting.hole_filling import FILLED, FROM_POINTS, Colours, shaded


def colours_of(inputs: Inputs, plan: Plan | None) -> tuple[Colours | None, bool]:
    """The points' colours, and whether they are their own (else their classes'); None where there are no points.

    What is coloured by points that were made up (`made.*`) is marked as filled. Points lend none where something stood
    on the `plan` that was taken out, or beside it: theirs is its shade, or its own.
    """
    names = sorted(name for name in inputs if name.startswith("cloud") and name != "cloud.rest")
    made = sorted(name for name in inputs if name.startswith("made."))
    clouds = [cloud for name in names + made if len(cloud := PointCloud.load(inputs[name]))]
    if not clouds:
        return None, False
    cloud = PointCloud.join(clouds)
    if cloud.rgb is None:
        return Colours(cloud.xyz, shaded(classes_of(cloud), cloud.normal), FILLED), False
    real = np.arange(len(cloud)) < len(cloud) - sum(len(PointCloud.load(inputs[name])) for name in made)
    known = cloud.coloured
    if plan is not None:
        known &= ~plan.beside(cloud.xyz)
    if not known.any():
        return None, False
    return Colours(
        cloud.xyz[known], cloud.rgb[known], np.where(real, FROM_POINTS, FILLED)[known].astype(np.uint8)
    ), True


def made_colours(inputs: Inputs) -> tuple[F32, U8]:
    """Places (N, 3) and colours (N, 3), their classes', of points that were made up."""
    clouds = [PointCloud.load(inputs[name]) for name in sorted(inputs) if name.startswith("made.")]
    if not clouds:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cloud = PointCloud.join(clouds)
    return cloud.xyz, shaded(classes_of(cloud), cloud.normal)


def classes_of(cloud: PointCloud) -> U8:
    """(N,) codes of the points' classes; 1, unclassified, where they aren't known."""
    return np.ones(len(cloud), np.uint8) if cloud.classification is None else cloud.classification
