"""Instances step (`instances`): detects vehicles and people and classifies all points of each (`vehicle_boxes`)."""

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
from scan2sim.pipeline.geometry.voxel_grid import voxel_groups
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.segmentation.steps.segment import SOURCE_CLOUD, SOURCE_SHAPE

if TYPE_CHECKING:
    from scan2sim.segmentation.vehicle_boxes import Instance, Scan

BRIEF_MAX_S, BRIEF_RADIUS_M, BRIEF_NEIGHBOURS = 1.0, 0.5, 16
"""A point was scanned briefly if its (up to 16) neighbours within 0.5 m were scanned within 1 s: a passing object."""
MOVED_RADIUS_M = 0.3
"""Metres to a dropped moving point within which a point belongs to the same object."""
SHAPE_WEIGHT = 0.6
"""Factor on the weight and the log odds of classes from shape alone, relative to classes from photos."""
PROBABILITY_MIN, PROBABILITY_MAX = 0.67, 0.9
"""Bounds of the probability of a predicted class: likelier than the others, but never certain."""


class InstancesParams(Params):
    """Settings of the detection of vehicles and people.

    Attributes:
        detect: detect instances; False keeps the classes of the points.
        size: size in metres of the voxels that are classified.
    """

    detect: bool = True
    size: Voxel = 0.1


def instances(inputs: Inputs, params: InstancesParams, out: Path, report: Report) -> Done:
    """Detect vehicles and people in the classified `cloud` and assign their class to all of their points.

    Inputs: `cloud`; `confidence` (of `segment`); `path`, the scanner's path (without it the cloud is kept); `moving`, a
    cloud of points that were dropped because they moved (optional). Classes that came with the cloud are kept.
    Files: `cloud`; `instances`, GeoJSON with the ground box of every instance in the tile's CRS, its `kind`,
    `length_m`, `width_m`, `height_m`, `heading_deg` (from x, counter-clockwise), `ground_z`, `points`, `moved` and
    `confidence`. Metrics: number of `vehicles`, of these `moved`, and of `people`; points `added` to instances, and
    points `reassigned` to other classes.
    """
    file, geojson_file = out / "cloud.npz", out / "instances.geojson"
    report(0.0, "reading")
    found: list[tuple[Instance, int]] = []
    cloud = PointCloud.load(inputs["cloud"]) if "path" in inputs else None
    classification = None if cloud is None else cloud.classification
    if cloud is not None and classification is not None:
        found, classification = detect(cloud, inputs, params, report)
    if (
        cloud is None
        or cloud.classification is None
        or classification is None
        or np.array_equal(classification, cloud.classification)
    ):
        link_or_copy(inputs["cloud"], file)
        added = back = 0
    else:
        report(0.9, "writing")
        movable = np.isin(cloud.classification, _movable()), np.isin(classification, _movable())
        added, back = int((movable[1] & ~movable[0]).sum()), int((movable[0] & ~movable[1]).sum())
        replace(cloud, classification=classification).save(file)
    _write_geojson(geojson_file, found, cloud.frame if cloud is not None else None)
    vehicles = [instance for instance, _ in found if instance.kind != "person"]
    metrics = {
        "vehicles": len(vehicles),
        "moved": sum(instance.moved for instance in vehicles),
        "people": len(found) - len(vehicles),
        "added": added,
        "reassigned": back,
    }
    return Done({"cloud": file, "instances": geojson_file}, metrics)


def detect(
    cloud: PointCloud, inputs: Inputs, params: InstancesParams, report: Report
) -> tuple[list[tuple[Instance, int]], U8]:
    """Instances with their numbers of points, and the class of every point (N,)."""
    from scan2sim.segmentation import vehicle_boxes

    assert cloud.classification is not None
    with np.load(inputs["confidence"]) as data:
        confidence, source = data["confidence"], data["source"]
    keep_classes = bool(len(source)) and bool((source == SOURCE_CLOUD).all())
    if keep_classes and not np.isin(cloud.classification, _movable()).any():
        return [], cloud.classification
    order, starts = voxel_groups(cloud.xyz, params.size)
    first, count = order[starts], np.diff(np.append(starts, len(order)))
    moving = PointCloud.load(inputs["moving"]).xyz if "moving" in inputs else np.zeros((0, 3), np.float32)
    report(0.3, "classifying ground")
    path = Trajectory.load(inputs["path"]).positions
    scan_times = None
    if cloud.time is not None:
        ordered = cloud.time[order]
        scan_times = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
    scan = voxel_scan(cloud.take(first), confidence[first], source[first], moving, scan_times, path)
    report(0.5, "detecting vehicles and people")
    found = vehicle_boxes.vehicles(scan) + vehicle_boxes.people(scan)
    numbered = [(instance, int(count[instance.index].sum())) for instance in found]
    if keep_classes:
        return numbered, cloud.classification
    thin = scan.classification.copy()
    back = np.union1d(vehicle_boxes.rejected_vehicle_points(scan, found), vehicle_boxes.rejected_person_points(scan))
    thin[back] = background_class(scan, back)
    for instance in found:
        thin[instance.index] = CODE["person" if instance.kind == "person" else "vehicle"]
    thin[vehicle_boxes.uncarved_moving_points(scan)] = CODE["vehicle"]
    changed = np.flatnonzero(thin != scan.classification)
    classification = cloud.classification.copy()
    at = np.concatenate([order[starts[i] : starts[i] + count[i]] for i in changed] or [np.zeros(0, np.int64)])
    classification[at] = np.repeat(thin[changed], count[changed])
    return numbered, classification


def voxel_scan(
    thin: PointCloud, confidence: U8, source: U8, moving: F32, scan_times: tuple[F64, F64] | None, path: F64
) -> Scan:
    """`Scan` of a cloud with one point per voxel.

    Args:
        thin: cloud with classes, one point per voxel.
        confidence, source: (N,) as written by the step `segment`.
        moving: (M, 3) points that were dropped because they moved.
        scan_times: (N,) each, seconds: when the voxel's points were scanned first and last; None if unknown.
        path: (T, 3) path of the scanner.
    """
    from scipy.spatial import cKDTree

    from scan2sim.segmentation.geometric import split_ground
    from scan2sim.segmentation.vehicle_boxes import Scan

    assert thin.classification is not None
    height, ground = split_ground(thin.xyz)
    p = np.clip(confidence / 255.0, PROBABILITY_MIN, PROBABILITY_MAX)
    odds = np.log(p / (1 - p)) * np.where(thin.classification == CODE["vehicle"], 1.0, -1.0)
    odds = np.where(source == SOURCE_SHAPE, SHAPE_WEIGHT * odds, odds)
    weight = np.where(source == SOURCE_SHAPE, SHAPE_WEIGHT, 1.0).astype(np.float32)
    moved = np.zeros(len(thin), bool)
    if len(moving):
        distance, _ = cKDTree(moving).query(thin.xyz, distance_upper_bound=MOVED_RADIUS_M, workers=-1)
        moved = np.isfinite(distance)
    brief = np.zeros(len(thin), bool)
    if len(moving) and scan_times is not None:
        above = np.flatnonzero(~ground)
        k = min(BRIEF_NEIGHBOURS, len(above))
        distance, near = cKDTree(thin.xyz[above]).query(thin.xyz[above], k=k, workers=-1)
        near = np.where(
            distance.reshape(len(above), -1) < BRIEF_RADIUS_M,
            near.reshape(len(above), -1),
            np.arange(len(above))[:, None],
        )
        brief[above] = scan_times[1][above][near].max(axis=1) - scan_times[0][above][near].min(axis=1) < BRIEF_MAX_S
    return Scan(thin.xyz, height, ground, thin.classification, odds.astype(np.float32), weight, moved, brief, path)


def background_class(scan: Scan, index: I64) -> U8:
    """Classes (K,) of points that belong to no instance: that of the nearest point on or above the ground."""
    from scipy.spatial import cKDTree

    terrain = group_of()[scan.classification] == 0
    out = scan.classification[index].copy()
    for low in (True, False):
        chosen = np.flatnonzero((scan.ground[index] | (scan.height[index] < 0.1)) == low)
        given = np.flatnonzero(terrain if low else ~terrain & ~np.isin(scan.classification, _movable()))
        if len(chosen) and len(given):
            distance, near = cKDTree(scan.xyz[given]).query(scan.xyz[index[chosen]], workers=-1)
            isolated = np.full(len(chosen), CODE["wall_or_fence"], np.uint8)
            out[chosen] = np.where((distance < 2.0) | low, scan.classification[given[near]], isolated)
    return out


def _write_geojson(path: Path, found: Sequence[tuple[Instance, int]], frame: Frame | None) -> None:
    """Write instances with their numbers of points as GeoJSON polygons."""
    from scan2sim.pipeline.io.geodata import geojson

    features = []
    for instance, points in found:
        assert frame is not None
        ring = np.column_stack([instance.corners, np.full(4, instance.centre[2])])
        vertices = frame.to_crs(np.concatenate([ring, ring[:1]]))
        properties = {
            "kind": instance.kind,
            "length_m": round(instance.length, 2),
            "width_m": round(instance.width, 2),
            "height_m": round(instance.height, 2),
            "heading_deg": round(float(np.degrees(instance.heading)) % 180, 1),
            "ground_z": round(float(vertices[0, 2]), 3),
            "points": points,
            "moved": instance.moved,
            "confidence": round(float(1 / (1 + np.exp(-instance.odds))), 3),
        }
        features.append((vertices[:, :2].round(3).tolist(), properties))
    geojson.write_polygons(path, frame.crs if frame else "local", features)


def _movable() -> tuple[int, int]:
    return CODE["vehicle"], CODE["person"]


INSTANCES = Step("instances", 3, instances, InstancesParams)
