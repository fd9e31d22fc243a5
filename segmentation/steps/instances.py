"""Things: vehicles and people as instances, all of each or nothing (kernels in instances.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import CODE, group_of
from scan2sim.pipeline.core.parameters import Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import pass_on
from scan2sim.pipeline.steps.voxel import voxel_groups
from scan2sim.segmentation.steps.segment import OWN, SHAPE

if TYPE_CHECKING:
    from scan2sim.segmentation.vehicle_boxes import Scan, Thing

PASSING, AROUND, NEIGHBOURS = 1.0, 0.5, 16
"""Seconds within which of what passes all is scanned that is within so many metres, of so many neighbours."""
NEAR = 0.3
"""Metres to a point that moved, within which a point is taken to be of the same thing."""
SHAPES_WORD = 0.6
"""What the word of shape alone counts beside a photo's, and how sure it is of itself."""
LEAST_SURE, MOST_SURE = 0.67, 0.9
"""Probabilities that a predicted class counts for: a photo's class is likelier than another, and never certain."""


class ThingsParams(Params):
    """How vehicles and people are found.

    Attributes:
        find: decide them as whole things; False leaves points as they were classified.
        size: metres of the voxels that are classified.
    """

    find: bool = True
    size: Voxel = 0.1


def things(inputs: Inputs, params: ThingsParams, out: Path, report: Report) -> Done:
    """Make vehicles and people in the classified `cloud` whole, with `confidence` (of `segment`).

    `path` is the scanner's; `moving`, a cloud of points that were dropped because they moved, is read where given. A
    cloud's own classes stay as they are. Tiles of a survey without a path keep their clouds.

    Files: `cloud`; `things`, GeoJSON with every thing's box on the ground, in the tile's CRS, its `kind`, `length_m`,
    `width_m`, `height_m`, `heading_deg` (from x, anticlockwise), `ground_z`, `points`, `moved` and `confidence`.
    Facts: `vehicles`, of these `moved`, `people`; points that were `added` to them, and `given_back` to other classes.
    """
    file, listed = out / "cloud.npz", out / "things.geojson"
    report(0.0, "reading")
    found: list[tuple[Thing, int]] = []
    cloud = PointCloud.load(inputs["cloud"]) if "path" in inputs else None
    classification = None if cloud is None else cloud.classification
    if cloud is not None and classification is not None:
        found, classification = decide(cloud, inputs, params, report)
    if (
        cloud is None
        or cloud.classification is None
        or classification is None
        or np.array_equal(classification, cloud.classification)
    ):
        pass_on(inputs["cloud"], file)
        added = back = 0
    else:
        report(0.9, "writing")
        movable = np.isin(cloud.classification, _movable()), np.isin(classification, _movable())
        added, back = int((movable[1] & ~movable[0]).sum()), int((movable[0] & ~movable[1]).sum())
        replace(cloud, classification=classification).save(file)
    _write_list(listed, found, cloud.frame if cloud is not None else None)
    cars = [thing for thing, _ in found if thing.kind != "person"]
    facts = {
        "vehicles": len(cars),
        "moved": sum(thing.moved for thing in cars),
        "people": len(found) - len(cars),
        "added": added,
        "given_back": back,
    }
    return Done({"cloud": file, "things": listed}, facts)


def decide(
    cloud: PointCloud, inputs: Inputs, params: ThingsParams, report: Report
) -> tuple[list[tuple[Thing, int]], U8]:
    """Things with their numbers of points, and the class of every point (N,)."""
    from scan2sim.segmentation import vehicle_boxes

    assert cloud.classification is not None
    with np.load(inputs["confidence"]) as data:
        sure, source = data["confidence"], data["source"]
    own = bool(len(source)) and bool((source == OWN).all())
    if own and not np.isin(cloud.classification, _movable()).any():
        return [], cloud.classification
    order, starts = voxel_groups(cloud.xyz, params.size)
    first, count = order[starts], np.diff(np.append(starts, len(order)))
    moving = PointCloud.load(inputs["moving"]).xyz if "moving" in inputs else np.zeros((0, 3), np.float32)
    report(0.3, "ground")
    path = Trajectory.load(inputs["path"]).positions
    moments = None
    if cloud.time is not None:
        ordered = cloud.time[order]
        moments = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
    scan = scan_of(cloud.take(first), sure[first], source[first], moving, moments, path)
    report(0.5, "things")
    found = vehicle_boxes.vehicles(scan) + vehicle_boxes.people(scan)
    numbered = [(thing, int(count[thing.index].sum())) for thing in found]
    if own:
        return numbered, cloud.classification
    thin = scan.classification.copy()
    back = np.union1d(vehicle_boxes.no_vehicles(scan, found), vehicle_boxes.no_people(scan))
    thin[back] = other_class(scan, back)
    for thing in found:
        thin[thing.index] = CODE["person" if thing.kind == "person" else "vehicle"]
    thin[vehicle_boxes.remains(scan)] = CODE["vehicle"]
    changed = np.flatnonzero(thin != scan.classification)
    classification = cloud.classification.copy()
    at = np.concatenate([order[starts[i] : starts[i] + count[i]] for i in changed] or [np.zeros(0, np.int64)])
    classification[at] = np.repeat(thin[changed], count[changed])
    return numbered, classification


def scan_of(thin: PointCloud, sure: U8, source: U8, moving: F32, moments: tuple[F64, F64] | None, path: F64) -> Scan:
    """What is known of one point a voxel.

    Args:
        thin: with labels.
        sure, source: (N,) as `segment` writes them.
        moving: (M, 3) points that were dropped because they moved.
        moments: (N,) each, seconds: when the voxel's points were scanned first and last; None where nothing tells.
        path: (T, 3) of the scanner.
    """
    from scipy.spatial import cKDTree

    from scan2sim.segmentation.geometric import split_ground
    from scan2sim.segmentation.vehicle_boxes import Scan

    assert thin.classification is not None
    height, ground = split_ground(thin.xyz)
    p = np.clip(sure / 255.0, LEAST_SURE, MOST_SURE)
    odds = np.log(p / (1 - p)) * np.where(thin.classification == CODE["vehicle"], 1.0, -1.0)
    odds = np.where(source == SHAPE, SHAPES_WORD * odds, odds)
    weight = np.where(source == SHAPE, SHAPES_WORD, 1.0).astype(np.float32)
    moved = np.zeros(len(thin), bool)
    if len(moving):
        distance, _ = cKDTree(moving).query(thin.xyz, distance_upper_bound=NEAR, workers=-1)
        moved = np.isfinite(distance)
    brief = np.zeros(len(thin), bool)
    if len(moving) and moments is not None:
        above = np.flatnonzero(~ground)
        k = min(NEIGHBOURS, len(above))
        distance, near = cKDTree(thin.xyz[above]).query(thin.xyz[above], k=k, workers=-1)
        near = np.where(
            distance.reshape(len(above), -1) < AROUND, near.reshape(len(above), -1), np.arange(len(above))[:, None]
        )
        brief[above] = moments[1][above][near].max(axis=1) - moments[0][above][near].min(axis=1) < PASSING
    return Scan(thin.xyz, height, ground, thin.classification, odds.astype(np.float32), weight, moved, brief, path)


def other_class(scan: Scan, index: I64) -> U8:
    """The classes (K,) of points that are of no thing: of the nearest on the ground, or above it, that is of none."""
    from scipy.spatial import cKDTree

    terrain = group_of()[scan.classification] == 0
    out = scan.classification[index].copy()
    for low in (True, False):
        chosen = np.flatnonzero((scan.ground[index] | (scan.height[index] < 0.1)) == low)
        given = np.flatnonzero(terrain if low else ~terrain & ~np.isin(scan.classification, _movable()))
        if len(chosen) and len(given):
            distance, near = cKDTree(scan.xyz[given]).query(scan.xyz[index[chosen]], workers=-1)
            alone = np.full(len(chosen), CODE["wall_or_fence"], np.uint8)
            out[chosen] = np.where((distance < 2.0) | low, scan.classification[given[near]], alone)
    return out


def _write_list(path: Path, found: Sequence[tuple[Thing, int]], frame: Frame | None) -> None:
    """A polygon a thing."""
    from scan2sim.pipeline.io.geodata import geojson

    features = []
    for thing, points in found:
        assert frame is not None
        ring = np.column_stack([thing.corners, np.full(4, thing.centre[2])])
        places = frame.to_crs(np.concatenate([ring, ring[:1]]))
        properties = {
            "kind": thing.kind,
            "length_m": round(thing.length, 2),
            "width_m": round(thing.width, 2),
            "height_m": round(thing.height, 2),
            "heading_deg": round(float(np.degrees(thing.heading)) % 180, 1),
            "ground_z": round(float(places[0, 2]), 3),
            "points": points,
            "moved": thing.moved,
            "confidence": round(float(1 / (1 + np.exp(-thing.odds))), 3),
        }
        features.append((places[:, :2].round(3).tolist(), properties))
    geojson.write_polygons(path, frame.crs if frame else "local", features)


def _movable() -> tuple[int, int]:
    return CODE["vehicle"], CODE["person"]


THINGS = Step("things", 3, things, ThingsParams)
