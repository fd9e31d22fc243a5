"""Colours of the point cloud for texels that no photo saw. Import late: it loads numba."""

from __future__ import annotations

import json

import numpy as np

from scan2sim.pipeline.core.classes import Group, surface_of
from scan2sim.pipeline.core.step import Inputs
from scan2sim.pipeline.core.types import F32, U8, Bools, PointCloud
from scan2sim.pipeline.geometry.height_map import exact_point_spacing
from scan2sim.texturing.inpainting.ground import GroundOrthophoto
from scan2sim.texturing.inpainting.hole_filling import PointColours, shaded
from scan2sim.texturing.texture_page import FILLED, FROM_POINTS


def point_colours(
    inputs: Inputs, ground: GroundOrthophoto | None, surface: Group | None = None
) -> tuple[PointColours | None, bool]:
    """Colours of the points, and whether they were measured (else they are class colours); None if there are no points.

    Class colours, and shades of them by intensity (`colour_source`), are those of the points of `surface`, if it has
    any: a floor isn't stained by the furniture on it, or by walls.
    Points of `uncovered` are sparser than others. Texels coloured by synthesized points (`synthesized.*`) are marked as
    filled. Points at and beside removed vehicles
    and people of the `ground` orthophoto are not used: they have the colour of the object or of its shadow.
    """
    names = sorted(name for name in inputs if name.startswith("cloud") and name != "cloud.rest")
    synthesized = sorted(name for name in inputs if name.startswith("synthesized."))
    sparse = ["uncovered"] if "uncovered" in inputs else []
    clouds = [cloud for name in names + sparse + synthesized if len(cloud := _finest(inputs, name))]
    if not clouds:
        return None, False
    cloud = PointCloud.join(clouds)
    if cloud.rgb is None:
        cloud = cloud.take(_of_surface(cloud, surface, np.ones(len(cloud), bool)))
        return PointColours(cloud.xyz, shaded(classes_of(cloud), cloud.normal), FILLED), False
    measured = np.arange(len(cloud)) < len(cloud) - sum(len(PointCloud.load(inputs[name])) for name in synthesized)
    usable = cloud.coloured
    if ground is not None:
        usable &= ~ground.near_removed(cloud.xyz)
    if _tinted(inputs):
        usable = _of_surface(cloud, surface, usable)
    if not usable.any():
        return None, False
    mark = np.where(measured, FROM_POINTS, FILLED)[usable].astype(np.uint8)
    spacing = np.zeros(len(cloud), np.float32)
    if sparse and (n := len(uncovered := PointCloud.load(inputs["uncovered"]))):
        start = int(measured.sum()) - n
        spacing[start : start + n] = exact_point_spacing(uncovered.xyz)
    return PointColours(cloud.xyz[usable], cloud.rgb[usable], mark, spacing[usable]), True


def _tinted(inputs: Inputs) -> bool:
    """Whether the points of a robot's map have shades of their classes' colours (step `map_colours`)."""
    source = inputs.get("colour_source")
    return source is not None and json.loads(source.read_text(encoding="utf-8"))["source"] == "intensity"


def _of_surface(cloud: PointCloud, surface: Group | None, usable: Bools) -> Bools:
    """(N,) those of the `usable` points whose classes have this surface; all of them if none has."""
    if surface is None:
        return usable
    own = usable & (surface_of([surface])[classes_of(cloud)] == 0)
    return own if own.any() else usable


def _finest(inputs: Inputs, name: str) -> PointCloud:
    """The cloud `cloud.CLASS`, or the points that it was thinned from (`raw.CLASS`) if they are given and coloured."""
    raw = name.replace("cloud.", "raw.", 1)
    cloud = PointCloud.load(inputs[raw if raw in inputs else name])
    return cloud if raw not in inputs or cloud.coloured.any() else PointCloud.load(inputs[name])


def synthesized_colours(inputs: Inputs) -> tuple[F32, U8]:
    """Positions (N, 3) and class colours (N, 3) of synthesized points."""
    clouds = [PointCloud.load(inputs[name]) for name in sorted(inputs) if name.startswith("synthesized.")]
    if not clouds:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cloud = PointCloud.join(clouds)
    return cloud.xyz, shaded(classes_of(cloud), cloud.normal)


def classes_of(cloud: PointCloud) -> U8:
    """(N,) class codes of the points; 1 (unclassified) if the cloud has no classes."""
    return np.ones(len(cloud), np.uint8) if cloud.classification is None else cloud.classification
