"""Segment step: a class for every point, the cloud's own or from photos and local shape (D3.2, section 4.2)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import group_of, name_of
from scan2sim.pipeline.core.parameters import Fraction, Voxel
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, PointCloud, Trajectory
from scan2sim.pipeline.geometry.voxel_grid import sample, voxel_groups
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.segmentation.steps.label import classified

SOURCE_PHOTO, SOURCE_SHAPE, SOURCE_CLOUD = 1, 2, 3
"""Source of a point's class: photos that see it (with its shape and neighbours), shape and neighbours alone, or the
input cloud."""


class SegmentContext(Context):
    """What a tile's map shows of itself.

    Attributes:
        spacing: typical distance of neighbouring points in metres, which the classification by shape scales with; None
            for dense clouds.
        indoor_spacing: the same of a robot's map of rooms, whose points are classified as such; None: any other cloud.
    """

    spacing: float | None = None
    indoor_spacing: float | None = None


class SegmentParams(Params):
    """Settings of the point classification.

    Attributes:
        overwrite: classify the points even if the cloud has classes.
        min_classified: share of points with a class (other than "never classified" and "unclassified") from which the
            cloud's own classes are kept.
        size: size in metres of the voxels that are classified by photos.
        voxel: voxel size in metres of the classification by shape (`segmentation.geometric`).
        photos: use the photos; False classifies by shape alone.
        context: whether the cloud is a robot's map of rooms.
    """

    overwrite: bool = False
    min_classified: Fraction = 0.2
    size: Voxel = 0.1
    voxel: Voxel = 0.2
    photos: bool = True
    context: SegmentContext = SegmentContext()


def segment(inputs: Inputs, params: SegmentParams, out: Path, report: Report) -> Done:
    """Keep the classes of `cloud`, or classify its points by `labels` (of the step `label`, for `views`) and shape.

    Inputs: `cloud`; `views` and `labels`; `path`, the scanner's path (optional); `moving`, moving points from the step
    `dynamic_objects`, which hide what is behind them in photos (optional).
    Files: `cloud`; `confidence`, .npz with `confidence` (N,) uint8, 255 is certain, and `source` (N,) uint8
    (`SOURCE_PHOTO`, `SOURCE_SHAPE` or `SOURCE_CLOUD`), and `alternative` (N,) uint8, LAS code of the likeliest class of
    something that doesn't move; 0 where photos didn't classify.
    """
    report(0.0, "reading")
    cloud = PointCloud.load(inputs["cloud"])
    file, confidence_file = out / "cloud.npz", out / "confidence.npz"
    own = classified(cloud.classification)
    evidence: dict[str, Any] = {}
    alternative = np.zeros(len(cloud), np.uint8)
    if cloud.classification is not None and own >= params.min_classified and not params.overwrite:
        link_or_copy(inputs["cloud"], file)
        classification, source = cloud.classification, "cloud"
        sources, confidence = np.full(len(cloud), SOURCE_CLOUD, np.uint8), np.full(len(cloud), 255, np.uint8)
    else:
        if params.context.indoor_spacing is not None:
            classification, confidence, evidence = _classify_rooms(cloud, params.context.indoor_spacing, report)
            sources = np.full(len(cloud), SOURCE_SHAPE, np.uint8)
        else:
            classification, confidence, sources, alternative, evidence = classify_points(cloud, inputs, params, report)
        report(0.95, "writing")
        replace(cloud, classification=classification).save(file)
        source = "rooms" if "storeys" in evidence else "photos and shape" if evidence else "shape"
    np.savez(confidence_file, confidence=confidence, source=sources, alternative=alternative)
    count = np.bincount(classification, minlength=256)
    metrics = {
        "source": source,
        "own_classes": round(own, 4),
        "points": {name_of(code): int(count[code]) for code in np.flatnonzero(count).tolist()},
    } | evidence
    warnings = []
    if source == "shape":
        why = "as requested, points were classified" if own else "the cloud has no classes: points were classified"
        warnings.append(f"classes: {why} from shape alone, which is less accurate than with photos")
    elif source == "cloud" and not np.isin(group_of()[np.flatnonzero(count)], (1, 2)).any():
        warnings.append(
            "the cloud's classes contain neither buildings nor vegetation; classify the points again with "
            "--set segment.overwrite=true"
        )
    elif "storeys" in evidence:
        if not evidence["floors"]:
            warnings.append("no floor found: its points may have been removed by a filter")
        if not evidence["walls"]:
            warnings.append("no walls found: is this a map of rooms? Otherwise run with --scene outdoor")
    elif evidence and evidence["sky_share"] > SKY_SHARE_MAX:
        warnings.append(
            f"{evidence['sky_share']:.0%} of the observations of points in photos show sky: check the poses and "
            "timestamps of the photos"
        )
    return Done({"cloud": file, "confidence": confidence_file}, metrics, warnings)


def _classify_rooms(cloud: PointCloud, spacing: float, report: Report) -> tuple[U8, U8, dict[str, Any]]:
    """LAS codes and confidence (N,) of the points of an indoor map, and metrics."""
    from scan2sim.segmentation.indoor import classify_indoor

    found = classify_indoor(cloud.xyz, spacing, lambda f, m="": report(0.05 + 0.85 * f, m))
    evidence = {
        "storeys": len(found.storeys),
        "floors": sum(storey.floor is not None for storey in found.storeys),
        "ceilings": sum(len(storey.ceilings) for storey in found.storeys),
        "walls": sum(map(len, found.walls)),
        "confidence": round(float(found.confidence.mean()) / 255, 3) if len(cloud) else 0.0,
    }
    return found.classification, found.confidence, evidence


SKY_SHARE_MAX = 0.15
"""Fraction of sightings that say sky above which a run warns."""


def classify_points(
    cloud: PointCloud, inputs: Inputs, params: SegmentParams, report: Report
) -> tuple[U8, U8, U8, U8, dict[str, Any]]:
    """LAS codes, confidence (255: certain), source and alternative of every point (N,), and metrics with photos."""
    from scan2sim.pipeline.geometry.normals import oriented_normals
    from scan2sim.segmentation.geometric import classify

    n = len(cloud)
    views = views_io.load(inputs["views"]) if "views" in inputs else ()
    by_photos = params.photos and "labels" in inputs and any(inputs["labels"].glob("*.npy"))
    if not by_photos:
        classification = classify(
            cloud,
            lambda f, m="": report(0.05 + 0.85 * f, m),
            voxel=params.voxel,
            spacing=params.context.spacing,
        )
        unsure, unknown = np.full(n, 128, np.uint8), np.zeros(n, np.uint8)
        return classification, unsure, np.full(n, SOURCE_SHAPE, np.uint8), unknown, {}
    report(0.05, "downsampling")
    order, starts = voxel_groups(cloud.xyz, params.size)
    voxel = np.empty(n, np.int64)
    voxel[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, n)))
    thin = sample(cloud, params.size)
    report(0.15, "normals")
    thin = oriented_normals(thin, 12, Trajectory.load(inputs["path"]) if "path" in inputs else None)
    report(0.25, "shape")
    shape = classify(thin, lambda f, m="": report(0.25 + 0.25 * f, m), voxel=params.voxel)
    moving = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    code, confidence, staying, seen, evidence = _from_photos(
        thin, shape, views, inputs["labels"], moving, params, report
    )
    source = np.where(seen, SOURCE_PHOTO, SOURCE_SHAPE).astype(np.uint8)
    return code[voxel], confidence[voxel], source[voxel], staying[voxel], evidence


def _from_photos(
    thin: PointCloud,
    shape: U8,
    views: Any,
    probabilities: Path,
    moving: PointCloud | None,
    params: SegmentParams,
    report: Report,
) -> tuple[U8, U8, U8, U8, dict[str, Any]]:
    """LAS code, confidence, code if it doesn't move, and whether a photo sees it, for each voxel; and metrics."""
    from scan2sim.segmentation.geometric import split_ground
    from scan2sim.segmentation.graph_smoothing import smooth_classes
    from scan2sim.segmentation.labels import code_of_index
    from scan2sim.segmentation.transient_points import transient
    from scan2sim.segmentation.votes import vote

    votes = vote(
        thin, views, probabilities, radius=0.8 * params.size, moving=moving,
        report=lambda f, m="": report(0.5 + 0.3 * f, m),
    )  # fmt: skip
    report(0.8, "smoothing")
    predicted = json.loads((probabilities / "network.json").read_text(encoding="utf-8"))["classes"]
    height, ground = split_ground(thin.xyz)
    moved = transient(thin, height, ground)
    best, probability, staying = smooth_classes(
        votes, shape, height, moved, thin, knows_low_vegetation="low_vegetation" in predicted
    )
    seen = votes.weight > 0
    evidence = {"seen_share": round(float(seen.mean()), 4), "sky_share": round(votes.sky_share, 4)}
    evidence["moving_share"] = round(float(moved.mean()), 4)
    codes, confidence = code_of_index(), np.round(255 * probability).astype(np.uint8)
    return codes[best], confidence, codes[staying], seen.astype(np.uint8), evidence


SEGMENT = Step("segment", 12, segment, SegmentParams, memory=(0.5, 6))
