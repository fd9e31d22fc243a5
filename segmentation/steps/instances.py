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
from scan2sim.pipeline.lidar.sweeps import scanner_origins
from scan2sim.segmentation.steps.segment import SOURCE_CLOUD, SOURCE_SHAPE

if TYPE_CHECKING:
    from scan2sim.segmentation.vehicle_boxes import Instance, Scan

BRIEF_MAX_S, BRIEF_RADIUS_M, BRIEF_NEIGHBOURS = 1.0, 0.5, 16
"""A point was scanned briefly if its (up to 16) neighbours within 0.5 m were scanned within 1 s: a passing object."""
MOVED_RADIUS_M = 0.3
"""Metres to a dropped moving point within which a point belongs to the same object."""
ADJACENT_M = 0.5
"""Distance within which the classes of standing points count for a cluster that is no vehicle."""
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
    points `reassigned` to other classes; `removed`, a list of what is removed: instances, and what was passing.
    """
    file, geojson_file = out / "cloud.npz", out / "instances.geojson"
    report(0.0, "reading")
    found: list[tuple[Instance, int]] = []
    removed: list[dict[str, object]] = []
    cloud = PointCloud.load(inputs["cloud"]) if "path" in inputs else None
    classification = None if cloud is None else cloud.classification
    if cloud is not None and classification is not None:
        found, removed, classification = detect(cloud, inputs, params, report)
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
        "removed": [_removed_instance(*one, cloud.frame) for one in found if cloud is not None] + removed,
    }
    return Done({"cloud": file, "instances": geojson_file}, metrics)


def detect(
    cloud: PointCloud, inputs: Inputs, params: InstancesParams, report: Report
) -> tuple[list[tuple[Instance, int]], list[dict[str, object]], U8]:
    """Instances with their numbers of points, what else is removed (`removed_clusters`), and classes (N,) of points."""
    from scan2sim.segmentation import vehicle_boxes

    assert cloud.classification is not None
    with np.load(inputs["confidence"]) as data:
        confidence, source, alternative = data["confidence"], data["source"], data["alternative"]
    keep_classes = bool(len(source)) and bool((source == SOURCE_CLOUD).all())
    if keep_classes and not np.isin(cloud.classification, _movable()).any():
        return [], [], cloud.classification
    order, starts = voxel_groups(cloud.xyz, params.size)
    first, count = order[starts], np.diff(np.append(starts, len(order)))
    moving = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    report(0.3, "classifying ground")
    path = Trajectory.load(inputs["path"])
    scan_times = None
    if cloud.time is not None:
        ordered = cloud.time[order]
        scan_times = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
    moving_xyz = np.zeros((0, 3), np.float32) if moving is None else moving.xyz
    scan = voxel_scan(cloud.take(first), confidence[first], source[first], moving_xyz, scan_times, path.positions)
    report(0.4, "following rays")
    scan = with_sightings(scan, cloud, moving, path)
    report(0.5, "detecting vehicles and people")
    found = vehicle_boxes.vehicles(scan) + vehicle_boxes.people(scan)
    numbered = [(instance, int(count[instance.index].sum())) for instance in found]
    if keep_classes:
        return numbered, [], cloud.classification
    thin = scan.classification.copy()
    still, passing = vehicle_boxes.loose_vehicle_points(scan, found)
    back = np.union1d(still, vehicle_boxes.rejected_person_points(scan))
    thin[back] = background_class(scan, back, alternative[first])
    for instance in found:
        thin[instance.index] = CODE["person" if instance.kind == "person" else "vehicle"]
    passing += vehicle_boxes.passing_points(scan)
    for cluster in passing:
        thin[cluster] = CODE["vehicle"]
    changed = np.flatnonzero(thin != scan.classification)
    classification = cloud.classification.copy()
    at = np.concatenate([order[starts[i] : starts[i] + count[i]] for i in changed] or [np.zeros(0, np.int64)])
    classification[at] = np.repeat(thin[changed], count[changed])
    return numbered, removed_clusters(scan, count, found, passing, cloud.frame), classification


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
    if scan_times is not None and not ground.all():
        above = np.flatnonzero(~ground)
        k = min(BRIEF_NEIGHBOURS, len(above))
        distance, near = cKDTree(thin.xyz[above]).query(thin.xyz[above], k=k, workers=-1)
        near = np.where(
            distance.reshape(len(above), -1) < BRIEF_RADIUS_M,
            near.reshape(len(above), -1),
            np.arange(len(above))[:, None],
        )
        brief[above] = scan_times[1][above][near].max(axis=1) - scan_times[0][above][near].min(axis=1) < BRIEF_MAX_S
    none = np.zeros(len(thin), np.int64)
    return Scan(
        thin.xyz, height, ground, thin.classification, odds.astype(np.float32), weight, moved, brief, none, none, path
    )


def with_sightings(scan: Scan, cloud: PointCloud, moving: PointCloud | None, path: Trajectory) -> Scan:
    """The scan with the sightings of what may be passing: points classified as vehicle, or scanned for a moment."""
    from scan2sim.pipeline.lidar.sightings import sightings

    if cloud.time is None or scanner_origins(cloud, path)[1]:
        return scan
    returns, times = cloud.xyz, cloud.time
    if moving is not None and moving.time is not None:
        returns, times = np.concatenate([returns, moving.xyz]), np.concatenate([times, moving.time])
    some = np.flatnonzero(~scan.ground & (scan.brief | (scan.classification == CODE["vehicle"])))
    seen, passed = scan.seen.copy(), scan.passed.copy()
    seen[some], passed[some] = sightings(scan.xyz[some], returns, times, path)
    return replace(scan, seen=seen, passed=passed)


def removed_clusters(
    scan: Scan, count: I64, found: Sequence[Instance], passing: Sequence[I64], frame: Frame
) -> list[dict[str, object]]:
    """What is removed without being an instance, the largest first: where, how large, why.

    Points of instances aren't listed, nor is a point twice. `count` (N,) is the number of points of each voxel.
    """
    from scan2sim.segmentation.vehicle_boxes import MIN_VOXELS, fit_rectangle

    listed = np.zeros(len(scan.xyz), bool)
    for instance in found:
        listed[instance.index] = True
    out: list[dict[str, object]] = []
    for cluster in passing:
        own = cluster[~listed[cluster]]
        listed[own] = True
        if len(own) < MIN_VOXELS:
            continue
        box, seen, passed = fit_rectangle(scan.xyz[own, :2]), scan.seen[own].mean(), scan.passed[own].mean()
        why = "touches what moved" if scan.moved[own].any() else "was on the road for a moment"
        if passed > seen:
            why = f"{seen:.1f} sweeps saw it, rays of {passed:.1f} passed its place"
        ground_z = float(np.median(scan.xyz[own, 2] - scan.height[own]))
        size = box.length, box.width, float(scan.height[own].max())
        points = int(count[own].sum())
        out.append(_removal("passing", np.array([box.x, box.y, ground_z]), size, points, True, why, frame))
    return sorted(out, key=lambda one: -int(str(one["points"])))


def _removed_instance(instance: Instance, points: int, frame: Frame) -> dict[str, object]:
    """Entry of an instance in the list of what is removed."""
    likely = 1 / (1 + np.exp(-instance.odds))
    why = "has the size of a person" if instance.kind == "person" else f"is a vehicle with probability {likely:.2f}"
    size = instance.length, instance.width, instance.height
    return _removal(instance.kind, instance.centre, size, points, instance.moved, why, frame)


def _removal(
    kind: str, place: F64, size: tuple[float, float, float], points: int, moved: bool, why: str, frame: Frame
) -> dict[str, object]:
    x, y, _ = frame.to_crs(place[None])[0]
    metres = {name: round(value, 2) for name, value in zip(("length_m", "width_m", "height_m"), size, strict=True)}
    at = {"x": round(float(x), 2), "y": round(float(y), 2)}
    return {"kind": kind, **at, **metres, "points": points, "moved": moved, "why": why}


def background_class(scan: Scan, index: I64, alternative: U8) -> U8:
    """Classes (K,) of points that belong to no instance.

    Low points take the class of the nearest ground. A cluster above it is one object: it takes the most frequent class
    by photos and shape, and of what touches it; without any, each point that of the nearest point.

    Args:
        scan: the scan.
        index: (K,) points.
        alternative: (N,) LAS codes of the likeliest class of something that doesn't move; 0 where unknown.
    """
    from scipy.spatial import cKDTree

    from scan2sim.segmentation.vehicle_boxes import clusters

    terrain = group_of()[scan.classification] == 0
    standing = ~terrain & ~np.isin(scan.classification, _movable())
    member = np.zeros(len(scan.xyz), bool)
    member[index] = True
    low = scan.ground | (scan.height < 0.1)
    out, touching = scan.classification.copy(), np.zeros(len(scan.xyz), bool)
    for chosen, given in ((member & low, terrain), (member & ~low, standing)):
        at, near = np.flatnonzero(chosen), np.flatnonzero(given)
        if len(at) and len(near):
            distance, nearest = cKDTree(scan.xyz[near]).query(scan.xyz[at], workers=-1)
            known = (distance < 2.0) | low[at]
            out[at] = np.where(known, scan.classification[near[nearest]], CODE["wall_or_fence"])
            touching[at] = distance < ADJACENT_M
    photos = np.where(group_of()[alternative] > 0, alternative, 0)
    for cluster in clusters(scan.xyz, member & ~low):
        votes = np.bincount(photos[cluster], minlength=256)
        votes += np.bincount(out[cluster[touching[cluster]]], minlength=256)
        votes[0] = 0
        if votes.any():
            out[cluster] = votes.argmax()
    return out[index]


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


INSTANCES = Step("instances", 4, instances, InstancesParams)
